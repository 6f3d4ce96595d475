# SPDX-License-Identifier: MIT OR Apache-2.0
"""Two readers of bags that are not ours, on a bag of ours: `bag_values.py BAG EXPECTED`.

EXPECTED has a line `<topic> <json>` for each message, in the order of each topic, with the values that rclpy gave it; rosbags and
mcap-ros2-support find the same. Prints how many messages they read, and the types for which rosbags computes another hash than ROS.
"""

import json
import math
import sys
from collections import defaultdict
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype


def same(value, expected):
    """Whether a field has the value that JSON has; what rclpy calls octet is a byte, what it calls float32 has fewer digits."""
    if isinstance(expected, dict):
        return all(same(getattr(value, name), part) for name, part in expected.items())
    if isinstance(expected, list):
        return len(value) == len(expected) and all(map(same, value, expected))
    if isinstance(expected, str) and not isinstance(value, str):
        value = float(value)
        return expected == ("NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity")
    if isinstance(expected, float):
        return value == expected or math.isclose(value, expected, rel_tol=1e-6, abs_tol=1e-44)
    if isinstance(value, bytes):
        value = value[0]
    # rosbags reads an octet as a signed number.
    return value == expected or value == expected - 256


def main():
    bag, expected = Path(sys.argv[1]), defaultdict(list)
    for line in Path(sys.argv[2]).read_text().splitlines():
        topic, values = line.split(" ", 1)
        expected[topic].append(json.loads(values))
    seen = {"rosbags": defaultdict(int), "mcap-ros2-support": defaultdict(int)}

    def see(reader, topic, decode):
        values = expected[topic][seen[reader][topic]]
        seen[reader][topic] += 1
        message = decode()
        if not same(message, values):
            sys.exit(f"{reader}: {topic}: {message} instead of {values}")

    types = get_typestore(Stores.EMPTY)
    with Reader(bag) as reader:
        # Neither has wstring.
        known = [connection for connection in reader.connections if "wstring" not in connection.msgdef.data]
        for connection in known:
            types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        # It calls parts of services otherwise, and so computes other hashes for them.
        messages = [connection for connection in known if "/srv/" not in connection.msgtype and "_action/" not in connection.topic]
        odd = [connection.msgtype for connection in messages if types.hash_rihs01(connection.msgtype) != connection.digest]
        for connection, _, cdr in reader.messages(known):
            see("rosbags", connection.topic, lambda: types.deserialize_cdr(cdr, normalize_msgtype(connection.msgtype)))
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            factory = DecoderFactory()
            for schema, channel, message in make_reader(stream).iter_messages():
                # It takes no name of a type that has a '_': none of a service's or action's.
                if b"wstring" not in schema.data and "_" not in schema.name.split("/")[-1]:
                    decode = factory.decoder_for(channel.message_encoding, schema)
                    see("mcap-ros2-support", channel.topic, lambda: decode(message.data))
    both = {connection.topic for connection in messages}
    for reader, topics in seen.items():
        for topic, messages in expected.items():
            if (topic in both or topics[topic]) and topics[topic] != len(messages):
                sys.exit(f"{reader}: {topics[topic]} of {len(messages)} messages of {topic}")
        print(reader, sum(topics.values()))
    print("other hashes", *sorted(odd))


if __name__ == "__main__":
    main()
