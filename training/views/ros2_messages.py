"""ROS 2 message definitions and their encoding, without ROS: what :mod:`training.views.mcap_file` writes.

The definitions are those of ``common_interfaces``, ``geometry2`` and ``rcl_interfaces``, less their comments; they
are the same from Humble to Kilted (by their type hashes). Messages are nested mappings; a field left out has its
default. The encoding is plain CDR, little endian, as ROS 2 sends it. Arrays of numbers may be NumPy's and are
copied whole.

Not the writer of ``mcap-ros2-support``: it encodes a map cell by cell, and cannot say which topics are latched,
without which RViz never hears of static transforms.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Message", "definition", "encode"]

Message = Mapping[str, Any]

_DEFINITIONS = {
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\nPose pose",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\nPoseWithCovariance pose",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\nTransform transform",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "nav_msgs/MapMetaData": """\
builtin_interfaces/Time map_load_time
float32 resolution
uint32 width
uint32 height
geometry_msgs/Pose origin""",
    "nav_msgs/OccupancyGrid": "std_msgs/Header header\nMapMetaData info\nint8[] data",
    "nav_msgs/Odometry": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist""",
    "nav_msgs/Path": "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/LaserScan": """\
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges
float32[] intensities""",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "visualization_msgs/Marker": """\
int32 ARROW=0
int32 CUBE=1
int32 SPHERE=2
int32 CYLINDER=3
int32 LINE_STRIP=4
int32 LINE_LIST=5
int32 CUBE_LIST=6
int32 SPHERE_LIST=7
int32 POINTS=8
int32 TEXT_VIEW_FACING=9
int32 MESH_RESOURCE=10
int32 TRIANGLE_LIST=11
int32 ARROW_STRIP=12
int32 ADD=0
int32 MODIFY=0
int32 DELETE=2
int32 DELETEALL=3
std_msgs/Header header
string ns
int32 id
int32 type
int32 action
geometry_msgs/Pose pose
geometry_msgs/Vector3 scale
std_msgs/ColorRGBA color
builtin_interfaces/Duration lifetime
bool frame_locked
geometry_msgs/Point[] points
std_msgs/ColorRGBA[] colors
string texture_resource
sensor_msgs/CompressedImage texture
UVCoordinate[] uv_coordinates
string text
string mesh_resource
MeshFile mesh_file
bool mesh_use_embedded_materials""",
    "visualization_msgs/MarkerArray": "Marker[] markers",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v",
}

_FORMATS = {
    "bool": "?", "int8": "b", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d",
}  # fmt: skip
_PACKERS = {name: struct.Struct(f"<{code}") for name, code in _FORMATS.items()}
_FIELD = re.compile(r"(?P<kind>[\w/]+)(?P<array>\[\d*\])?\s+(?P<name>\w+)(?:\s+(?P<default>\S+))?")
_SEPARATOR = "=" * 80


class _Field(NamedTuple):
    name: str
    kind: str  # a primitive, or package/Name
    length: int | None  # None: a single value; 0: a sequence of any length
    default: float


def definition(datatype: str) -> str:
    """Return a message's definition and those of all it is made of, as MCAP and rosbag2 keep them.

    ``datatype`` is written ``package/msg/Name``.
    """
    first = _short(datatype)
    found = [first]
    for name in found:  # it grows meanwhile
        found += [f.kind for f in _fields(name) if f.kind in _DEFINITIONS and f.kind not in found]
    parts = [_DEFINITIONS[first], *(f"MSG: {name}\n{_DEFINITIONS[name]}" for name in dict.fromkeys(found[1:]))]
    return f"\n{_SEPARATOR}\n".join(parts) + "\n"


def encode(datatype: str, message: Message) -> bytes:
    """Return a message ``package/msg/Name`` in CDR.

    Raises
    ------
    ValueError
        Where the message has a field that its definition has not, or an array of another length.
    """
    out = bytearray(b"\x00\x01\x00\x00")  # plain CDR, little endian
    _write(out, _short(datatype), message)
    return bytes(out)


def _short(datatype: str) -> str:
    return datatype.replace("/msg/", "/")


@cache
def _fields(name: str) -> tuple[_Field, ...]:
    package = name.partition("/")[0]
    fields = []
    for line in _DEFINITIONS[name].splitlines():
        match = _FIELD.fullmatch(line)
        if match is None:
            continue  # a constant
        kind, array = match["kind"], match["array"]
        if kind not in _FORMATS and kind != "string" and "/" not in kind:
            kind = f"{package}/{kind}"
        length = None if array is None else int(array[1:-1] or 0)
        fields.append(_Field(match["name"], kind, length, float(match["default"] or 0)))
    return tuple(fields)


def _write(out: bytearray, name: str, message: Message) -> None:
    fields = _fields(name)
    if not message.keys() <= {f.name for f in fields}:
        unknown = sorted(message.keys() - {f.name for f in fields})
        raise ValueError(f"{name} has no {', '.join(unknown)}; it has {', '.join(f.name for f in fields)}")
    for field in fields:
        value = message.get(field.name)
        if field.length is not None:
            _write_array(out, name, field, () if value is None else value)
        elif field.kind == "string":
            text = (value or "").encode() + b"\0"
            _pack(out, "uint32", len(text))
            out += text
        elif field.kind in _FORMATS:
            given = field.default if value is None else value
            _pack(out, field.kind, given if field.kind.startswith("float") else int(given))
        else:
            _write(out, field.kind, {} if value is None else value)


def _write_array(out: bytearray, name: str, field: _Field, values: Sequence[Any] | np.ndarray[Any, Any]) -> None:
    if field.length:
        values = values if len(values) else np.zeros(field.length)
        if len(values) != field.length:
            raise ValueError(f"{name}.{field.name} is {field.length} values, got {len(values)}")
    else:
        _pack(out, "uint32", len(values))
    if not len(values):
        return
    if field.kind in _FORMATS:
        _align(out, _PACKERS[field.kind].size)
        out += np.asarray(values, np.dtype(f"<{_FORMATS[field.kind]}")).tobytes()
    else:
        for value in values:
            _write(out, field.kind, value)


def _pack(out: bytearray, kind: str, value: Any) -> None:
    packer = _PACKERS[kind]
    _align(out, packer.size)
    out += packer.pack(value)


def _align(out: bytearray, size: int) -> None:
    out += bytes((4 - len(out)) % size)  # counted from behind the four bytes of the header
