# SPDX-License-Identifier: MIT OR Apache-2.0
"""Bags as rosbags writes and reads them.

`bag_kinds.py write FOLDER` writes one bag in every storage, version and compression that rosbags has, and prints their names.
`bag_kinds.py same BAG OTHER` compares what rosbags reads of two bags: connections with types, definitions, hashes and QoS, and each
message's bytes and time; prints how many messages there are.
"""

import random
import sys
from pathlib import Path

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

INFINITE = QosTime(9223372036, 854775807)
# Each policy once; what Foxy wrote for 'none'; several publishers; none.
PROFILES = [
    [Qos(QosHistory.KEEP_LAST, 3, QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL, QosTime(0, 20), QosTime(1, 5),
         QosLiveliness.MANUAL_BY_TOPIC, QosTime(7, 0), False)],
    [Qos(QosHistory.KEEP_ALL, 1, QosReliability.RELIABLE, QosDurability.VOLATILE, INFINITE, QosTime(2147483647, 4294967295),
         QosLiveliness.AUTOMATIC, INFINITE, True),
     Qos(QosHistory.UNKNOWN, 0, QosReliability.UNKNOWN, QosDurability.UNKNOWN, QosTime(0, 0), QosTime(0, 0),
         QosLiveliness.UNKNOWN, QosTime(0, 0), False)],
    [],
]
TOPICS = [
    ("/chatter", "std_msgs/msg/String"), ("/ns/imu", "sensor_msgs/msg/Imu"), ("/scan", "sensor_msgs/msg/LaserScan"),
    ("/silent", "geometry_msgs/msg/Pose"),
]
MESSAGES = 300
START_NS = 1763918546_123456789


def write(folder):
    types = get_typestore(Stores.ROS2_JAZZY)
    for version in (8, 9):
        for storage in (StoragePlugin.SQLITE3, StoragePlugin.MCAP):
            for mode in CompressionMode:
                if mode == CompressionMode.STORAGE and storage == StoragePlugin.SQLITE3:
                    continue
                name = f"{version}_{storage.name}_{mode.name}".lower()
                writer = Writer(folder / name, version=version, storage_plugin=storage)
                writer.set_compression(mode, CompressionFormat.ZSTD)
                writer.set_custom_data("robot", "number 5")
                words = random.Random(7)
                with writer:
                    connections = [
                        writer.add_connection(topic, of_type, typestore=types, offered_qos_profiles=PROFILES[n % 3])
                        for n, (topic, of_type) in enumerate(TOPICS)
                    ]
                    for n in range(MESSAGES):
                        # Some have one time; what is in them is anybody's.
                        body = bytes([0, 1, 0, 0]) + words.randbytes(words.choice([4, 40, 4000]))
                        writer.write(connections[words.randrange(3)], START_NS + n // 3 * 1_000_000, body)
                print(name)


def read(bag):
    with Reader(bag) as reader:
        connections = sorted(
            (each.topic, each.msgtype, str(each.msgdef.format), each.msgdef.data, each.digest, each.msgcount,
             each.ext.serialization_format, each.ext.offered_qos_profiles)
            for each in reader.connections
        )
        messages = [(log_ns, each.topic, bytes(cdr)) for each, log_ns, cdr in reader.messages()]
    # Readers are free to give those of one time in any order, but for those of one topic.
    messages.sort(key=lambda message: message[:2])
    return connections, messages


def same(bag, other):
    for one, another in zip(read(bag), read(other)):
        if len(one) != len(another):
            sys.exit(f"{len(one)} and {len(another)}")
        for left, right in zip(one, another):
            if left != right:
                sys.exit(f"{str(left)[:3000]}\nis not\n{str(right)[:3000]}")
    print(len(read(other)[1]))


if __name__ == "__main__":
    if sys.argv[1] == "write":
        write(Path(sys.argv[2]))
    else:
        same(Path(sys.argv[2]), Path(sys.argv[3]))
