"""The sensors' random numbers: those of a NumPy generator over PCG64, number for number, drawn three times faster.

Two numbers a beam and step are a tenth of what a step's sensing costs. NumPy draws each by two calls through
pointers, and PCG64's multiplication waits for the one before; here four of its states advance side by side, each
by four steps at once (theory: Brown, "Random number generation with arbitrary strides", 1994).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from slam.types import Array

try:  # NumPy's tables for the ziggurat, which Numba has copied and NumPy does not hand out
    from numba.np.random._constants import fi_double as _FI
    from numba.np.random._constants import ki_double as _KI
    from numba.np.random._constants import wi_double as _WI
except ImportError:  # private to Numba: then NumPy's own generator does
    _FI = _WI = np.zeros(256)
    _KI = np.zeros(0, np.uint64)

__all__ = ["NoiseStream", "RandomNumbers", "fill_normal", "fill_uniform", "noise_stream"]

Words = NDArray[np.uint64]

_MASK = 2**64 - 1
_MULTIPLIER = (2549297995355413924 << 64) + 4865540595714422341  # PCG64's
_TAIL, _INVERSE_TAIL = 3.6541528853610087963519472518, 0.27366123732975827203338247596
_LANES = 4  # states side by side in _fill_raw


class NoiseStream:
    """Where a stream of random numbers is: :func:`fill_normal` and :func:`fill_uniform` draw from its ``words``.

    They draw what ``np.random.Generator(bits)`` would; ``bits`` itself stays where it is.

    Attributes
    ----------
    words : NDArray[np.uint64]
        ``(5, 2)``: the state, which every kernel that draws advances in place, then multiplier and offset of one
        step and of four; of each the high word and the low one.
    """

    def __init__(self, bits: np.random.PCG64) -> None:
        state = bits.state["state"]
        now, increment = int(state["state"]), int(state["inc"])
        multiplier, offset = 1, 0  # of k steps at once, s → multiplier · s + offset
        numbers = [now]
        for k in range(1, _LANES + 1):
            multiplier = multiplier * _MULTIPLIER % 2**128
            offset = (offset * _MULTIPLIER + increment) % 2**128
            if k in (1, _LANES):
                numbers += [multiplier, offset]
        self.words = np.array([[v >> 64, v & _MASK] for v in numbers], np.uint64)


RandomNumbers = np.random.Generator | NoiseStream


def noise_stream(seed: np.random.SeedSequence) -> RandomNumbers:
    """Return the stream of ``np.random.Generator(np.random.PCG64(seed))``."""
    bits = np.random.PCG64(seed)
    return NoiseStream(bits) if len(_KI) else np.random.Generator(bits)


@intrinsic
def _high_word(typing_context: Any, a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two words."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = ir.IntType(128)
        product = builder.mul(builder.zext(args[0], wide), builder.zext(args[1], wide))
        return builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), generate


@njit(cache=True, nogil=True, inline="always")
def _advance(high: int, low: int, m_high: int, m_low: int, c_high: int, c_low: int) -> tuple[Any, Any]:
    """Return m · state + c modulo 2¹²⁸."""
    new_low = low * m_low + c_low
    carry = np.uint64(new_low < c_low)
    above: Any = _high_word(low, m_low)  # type: ignore[call-arg]
    return above + high * m_low + low * m_high + c_high + carry, new_low


@njit(cache=True, nogil=True, inline="always")
def _output(high: int, low: int) -> Any:
    """Return the word that PCG64 makes of a state: its halves' exclusive or, turned by its six highest bits."""
    value, turn = high ^ low, high >> np.uint64(58)
    return (value >> turn) | (value << ((np.uint64(64) - turn) & np.uint64(63)))


@njit(cache=True, nogil=True)
def _next(words: Words) -> Any:
    high, low = _advance(words[0, 0], words[0, 1], words[1, 0], words[1, 1], words[2, 0], words[2, 1])
    words[0, 0], words[0, 1] = high, low
    return _output(high, low)


@njit(cache=True, nogil=True)
def _fill_raw(words: Words, raw: Words, n: int) -> None:
    """Write the next ``n`` words, from four states that advance by four steps each."""
    whole = n - n % 4
    if whole:
        m_high, m_low, c_high, c_low = words[1, 0], words[1, 1], words[2, 0], words[2, 1]
        h0, l0 = _advance(words[0, 0], words[0, 1], m_high, m_low, c_high, c_low)
        h1, l1 = _advance(h0, l0, m_high, m_low, c_high, c_low)
        h2, l2 = _advance(h1, l1, m_high, m_low, c_high, c_low)
        h3, l3 = _advance(h2, l2, m_high, m_low, c_high, c_low)
        m_high, m_low, c_high, c_low = words[3, 0], words[3, 1], words[4, 0], words[4, 1]
        high, low = h3, l3
        for k in range(np.uint64(0), np.uint64(whole), np.uint64(4)):
            raw[k], raw[k + np.uint64(1)] = _output(h0, l0), _output(h1, l1)
            raw[k + np.uint64(2)], raw[k + np.uint64(3)] = _output(h2, l2), _output(h3, l3)
            high, low = h3, l3
            h0, l0 = _advance(h0, l0, m_high, m_low, c_high, c_low)
            h1, l1 = _advance(h1, l1, m_high, m_low, c_high, c_low)
            h2, l2 = _advance(h2, l2, m_high, m_low, c_high, c_low)
            h3, l3 = _advance(h3, l3, m_high, m_low, c_high, c_low)
        words[0, 0], words[0, 1] = high, low
    for k in range(whole, n):
        raw[k] = _next(words)


@njit(cache=True, nogil=True, inline="always")
def _to_uniform(word: int) -> float:
    return np.float64(word >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def fill_uniform(words: Words, out: Array) -> None:
    """Fill ``out`` with uniform numbers in [0, 1)."""
    n = out.shape[0]
    raw = np.empty(n, np.uint64)
    _fill_raw(words, raw, n)
    for k in range(n):
        out[k] = _to_uniform(raw[k])


@njit(cache=True, nogil=True)
def fill_normal(words: Words, out: Array) -> None:
    """Fill ``out`` by the ziggurat as NumPy does; each number takes a word, one in eighty takes more."""
    n = out.shape[0]
    raw = np.empty(n, np.uint64)
    _fill_raw(words, raw, n)
    used = 0
    for k in range(n):
        while True:
            word = raw[used] if used < n else _next(words)
            used += 1
            layer = word & np.uint64(255)
            size = (word >> np.uint64(9)) & np.uint64(0x000FFFFFFFFFFFFF)
            x = np.float64(size) * _WI[layer]
            # The sign without a branch, which the processor would guess wrongly every other time.
            x = math.copysign(x, np.float64(np.int64(127) - np.int64(word & np.uint64(256))))
            if size < _KI[layer]:
                break
            if layer == 0:
                while True:
                    u, used = _uniform(words, raw, n, used)
                    v, used = _uniform(words, raw, n, used)
                    beyond = -_INVERSE_TAIL * math.log1p(-u)
                    y = -math.log1p(-v)
                    if y + y > beyond * beyond:
                        break
                x = -(_TAIL + beyond) if (size >> np.uint64(8)) & np.uint64(1) else _TAIL + beyond
                break
            u, used = _uniform(words, raw, n, used)
            if (_FI[layer - np.uint64(1)] - _FI[layer]) * u + _FI[layer] < math.exp(-0.5 * x * x):
                break
        out[k] = x


@njit(cache=True, nogil=True)
def _uniform(words: Words, raw: Words, n: int, used: int) -> tuple[float, int]:
    word = raw[used] if used < n else _next(words)
    return _to_uniform(word), used + 1
