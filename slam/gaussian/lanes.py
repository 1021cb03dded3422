"""Short vectors of float64 in Numba kernels: a tile of a matrix stays in registers from first term to last.

Numba's own vectorising writes every sum back to memory after a few terms, and where there is AVX-512 it uses half
of the vectors' width: together that makes a product like Wᵀ W take twice the time. So here are vectors as values,
to be loaded from an array, multiplied, summed and stored. LLVM splits them where the machine's own are shorter.
Every entry is rounded alike wherever in a tile it stands, and however many lanes there are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import models, register_model
from numpy.typing import NDArray

if TYPE_CHECKING:

    def intrinsic(function: Any) -> Any:
        """Stand in for Numba's, whose type is that of the generator, not of what a kernel calls."""
else:
    from numba.extending import intrinsic

__all__ = [
    "LANES",
    "add_product",
    "aligned_zeros",
    "first",
    "load",
    "store",
    "subtract_number",
    "subtract_product",
    "times",
]

try:
    _FEATURES = dict(llvm.get_host_cpu_features())
except RuntimeError:  # LLVM cannot tell on every kind of machine
    _FEATURES = {}
LANES = 8 if _FEATURES.get("avx512f", False) else 4
# Fused where an x86 machine can, and always there (elsewhere never: other last bits). Left to the compiler
# ("contract"), which products and sums are rounded once depends on what it inlines, and that on which kernels come
# from the cache.
_FUSED = bool(_FEATURES.get("fma", False))

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)
_INDEX = ir.VectorType(ir.IntType(64), LANES)
_I32 = ir.IntType(32)


class _Vector(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Vector{LANES}")


class _Mask(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Mask{LANES}")


_vector, _mask = _Vector(), _Mask()


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _VECTOR)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _MASK)


def aligned_zeros(rows: int, columns: int) -> NDArray[np.float64]:
    """Return zeros ``(rows, ≥ columns)`` whose rows begin where a cache line does: no vector then needs two.

    A row is an odd number of cache lines long: the entries of a column do not contend for the same few places in
    the cache.
    """
    line = 8
    lines = -(-columns // line) | 1
    flat = np.zeros(rows * lines * line + line - 1)
    start = -(flat.ctypes.data // flat.itemsize) % line
    return flat[start : start + rows * lines * line].reshape(rows, lines * line)


@intrinsic
def first(typing: Any, count: Any) -> Any:
    """Return the mask that leaves only the first ``count`` lanes, none if it is negative."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lane = ir.Constant(_INDEX, list(range(LANES)))
        return builder.icmp_signed("<", lane, _splat(builder, args[0], _INDEX))

    return _mask(types.int64), generate


@intrinsic
def load(typing: Any, array: Any, index: Any, mask: Any) -> Any:
    """Return the vector that begins at ``array[index]``; lanes that ``mask`` (or None) leaves out are 0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _pointer(context, builder, signature, args)
        if not isinstance(mask, _Mask):
            return builder.load(at, align=8)
        function = _declared(builder, "load", _VECTOR, [at.type, _I32, _MASK, _VECTOR])
        return builder.call(function, [at, _I32(8), args[2], ir.Constant(_VECTOR, [0.0] * LANES)])

    return _vector(array, _index_type(index), mask), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, mask: Any, value: Any) -> Any:
    """Write a vector to where ``array[index]`` begins, but for the lanes that ``mask`` (or None) leaves out."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _pointer(context, builder, signature, args)
        if isinstance(mask, _Mask):
            function = _declared(builder, "store", ir.VoidType(), [_VECTOR, at.type, _I32, _MASK])
            builder.call(function, [args[3], at, _I32(8), args[2]])
        else:
            builder.store(args[3], at, align=8)
        return context.get_dummy_value()

    return types.void(array, _index_type(index), mask, _vector), generate


@intrinsic
def subtract_product(typing: Any, total: Any, factor: Any, vector: Any) -> Any:
    """Return ``total − factor · vector`` of a vector, a number and a vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        minus = builder.fneg(_splat(builder, args[1], _VECTOR))
        return _multiply_add(builder, minus, args[2], args[0])

    return _vector(_vector, types.float64, _vector), generate


@intrinsic
def subtract_number(typing: Any, total: Any, factor: Any, value: Any) -> Any:
    """Return ``total − factor · value`` of three numbers, rounded as :func:`subtract_product` rounds a lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, builder.fneg(args[1]), args[2], args[0])

    return types.float64(types.float64, types.float64, types.float64), generate


@intrinsic
def add_product(typing: Any, total: Any, factor: Any, vector: Any) -> Any:
    """Return ``total + factor · vector`` of a vector, a number and a vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, _splat(builder, args[1], _VECTOR), args[2], args[0])

    return _vector(_vector, types.float64, _vector), generate


@intrinsic
def times(typing: Any, factor: Any, vector: Any) -> Any:
    """Return ``factor · vector`` of a number and a vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(_splat(builder, args[0], _VECTOR), args[1])

    return _vector(types.float64, _vector), generate


def _index_type(index: Any) -> Any:
    return types.UniTuple(types.intp, len(index)) if isinstance(index, types.BaseTuple) else types.intp


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array_type, index_type = signature.args[:2]
    array = context.make_array(array_type)(context, builder, args[0])
    index = cgutils.unpack_tuple(builder, args[1]) if isinstance(index_type, types.BaseTuple) else [args[1]]
    at = cgutils.get_item_pointer(context, builder, array_type, array, index, wraparound=False)
    return builder.bitcast(at, _VECTOR.as_pointer())


def _splat(builder: Any, value: Any, vector: Any) -> Any:
    """Return a vector with ``value`` in every lane."""
    undefined = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(undefined, value, _I32(0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c of vectors or of numbers."""
    if not _FUSED:
        return builder.fadd(builder.fmul(a, b), c)
    name = f"llvm.fma.v{LANES}f64" if a.type == _VECTOR else "llvm.fma.f64"
    kind = ir.FunctionType(a.type, [a.type] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [a, b, c])


def _declared(builder: Any, what: str, result: Any, args: Any) -> Any:
    name = f"llvm.masked.{what}.v{LANES}f64.p0"
    return cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, args), name)
