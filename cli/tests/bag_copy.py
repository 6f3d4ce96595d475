# SPDX-License-Identifier: MIT OR Apache-2.0
"""A bag as another writer writes it: `bag_copy.py BAG NEW` has rosbags write the messages of BAG anew."""

import sys

from rosbags.rosbag2 import Reader, StoragePlugin, Writer


def main():
    with Reader(sys.argv[1]) as reader, Writer(sys.argv[2], version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        copies = {
            connection.id: writer.add_connection(
                connection.topic,
                connection.msgtype,
                msgdef=connection.msgdef.data,
                rihs01=connection.digest,
                offered_qos_profiles=connection.ext.offered_qos_profiles,
            )
            for connection in reader.connections
        }
        for connection, log_ns, cdr in reader.messages():
            writer.write(copies[connection.id], log_ns, cdr)


if __name__ == "__main__":
    main()
