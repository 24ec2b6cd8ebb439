"""Helpers that write rosbag2 folders with the library ``rosbags``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mcap_files import Message, cdr
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
FILE, MESSAGE, STORAGE = CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE


def write_bag(
    folder: Path,
    messages: Sequence[Message],
    storage: StoragePlugin = SQLITE,
    compression: CompressionMode | None = None,
    custom: dict[str, str] | None = None,
) -> Path:
    """Write a bag of JointState messages and one topic of another type."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    for key, value in (custom or {}).items():
        writer.set_custom_data(key, value)
    with writer:
        connections = {}
        other = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, "sensor_msgs/msg/JointState", typestore=STORE
                )
            log_time = message.stamp if message.log_time is None else message.log_time
            writer.write(connections[message.topic], log_time, cdr(message))
            writer.write(other, log_time, b"\0\1\0\0\2\0\0\0a\0")
    return folder
