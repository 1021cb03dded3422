"""Files of unknown origin: whatever the project reads is read here, bounded, with every fault in one line.

``reading`` is bytes, gzip, JSON, TOML and YAML, ``databases`` SQLite, ``bags`` what ROS 2 recorded, ``names`` how
names from outside are shown.
"""

from slam.files.bags import ROS1_BAG, ROS1_REMEDY, BagMessage, bag_messages, is_bag
from slam.files.databases import check_tables, open_database, trust
from slam.files.names import plain_name, quoted, shown_path
from slam.files.reading import (
    check_file,
    open_bounded,
    parse_json,
    parse_toml,
    parse_yaml,
    read_bytes,
    read_json,
    read_toml,
)

__all__ = [
    "ROS1_BAG",
    "ROS1_REMEDY",
    "BagMessage",
    "bag_messages",
    "check_file",
    "check_tables",
    "is_bag",
    "open_bounded",
    "open_database",
    "parse_json",
    "parse_toml",
    "parse_yaml",
    "plain_name",
    "quoted",
    "read_bytes",
    "read_json",
    "read_toml",
    "shown_path",
    "trust",
]
