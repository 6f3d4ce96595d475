# SPDX-License-Identifier: MIT OR Apache-2.0
"""A node of zenoh-ros2-sdk that publishes what it is given as CDR, or says what it hears as CDR: both through the
SDK's own message objects. peer.py (publish|subscribe) PORT DOMAIN TOPIC TYPE HASH DEFINITION_FILE"""
import dataclasses
import sys
import threading

from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

role, port, domain, topic, type_name, type_hash, definition_file = sys.argv[1:]
definition = open(definition_file).read()
arguments = dict(
    topic=topic, msg_type=type_name, msg_definition=definition, type_hash=type_hash, domain_id=int(domain),
    router_ip="127.0.0.1", router_port=int(port), node_name="their_node", namespace="/theirs",
)


def store():
    return ZenohSession.get_instance("127.0.0.1", int(port)).store


if role == "publish":
    publisher = ROS2Publisher(**arguments)
    print("started", flush=True)
    for line in sys.stdin:
        message = store().deserialize_cdr(bytes.fromhex(line.strip()), type_name)
        fields = {f.name: getattr(message, f.name) for f in dataclasses.fields(message) if f.name != "__msgtype__"}
        publisher.publish(**fields)
    publisher.close()
else:
    def heard(message):
        print("heard", bytes(store().serialize_cdr(message, type_name)).hex(), flush=True)

    subscriber = ROS2Subscriber(callback=heard, **arguments)
    print("started", flush=True)
    sys.stdin.read()
    subscriber.close()
