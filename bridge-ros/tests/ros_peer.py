# SPDX-License-Identifier: MIT OR Apache-2.0
"""A ROS 2 node that does what it is told: one JSON object per line in, one per line out.

It waits for what it is told to wait for, and for nothing else: whoever started it decides how long that may take.
"""

import array
import hashlib
import json
import os
import random
import sys
import threading

import rclpy
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

sys.path.insert(0, os.path.join(os.path.dirname(__file__), "../../msgs/schema/tests"))
import ros_values  # noqa: E402


def profile(qos):
    return QoSProfile(
        depth=qos.get("depth", 10),
        history=HistoryPolicy.KEEP_ALL if qos.get("keep_all") else HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.BEST_EFFORT if qos.get("best_effort") else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.get("latched") else DurabilityPolicy.VOLATILE,
    )


class Peer:
    executor = SingleThreadedExecutor

    def __init__(self, name):
        rclpy.init()
        self.node = rclpy.create_node(name, start_parameter_services=False, enable_rosout=False)
        self.ends = []
        self.received = {}
        self.incompatible = {}
        self.changed = threading.Condition()
        self.spinning = self.executor()
        self.spinning.add_node(self.node)
        self.spinner = threading.Thread(target=self.spinning.spin, daemon=True)
        self.spinner.start()

    def note_incompatible(self, index):
        def note(event):
            with self.changed:
                self.incompatible[index] = str(event.last_policy_kind)
                self.changed.notify_all()
        return note

    def publisher(self, topic, type, qos):
        index = len(self.ends)
        callbacks = PublisherEventCallbacks(incompatible_qos=self.note_incompatible(index))
        self.ends.append(self.node.create_publisher(ros_values.find(type), topic, profile(qos), event_callbacks=callbacks))
        return index

    def subscription(self, topic, type, qos, digest=False):
        index = len(self.ends)
        self.received[index] = []
        cls = ros_values.find(type)

        def receive(message):
            value = digest_of(message) if digest else ros_values.plain_message(message)
            with self.changed:
                self.received[index].append(value)
                self.changed.notify_all()

        callbacks = SubscriptionEventCallbacks(incompatible_qos=self.note_incompatible(index))
        self.ends.append(self.node.create_subscription(cls, topic, receive, profile(qos), event_callbacks=callbacks))
        return index

    def watched_subscription(self, topic, deadline_ms):
        """Of texts, one message deep; what happens to it is kept, and asked for with `happened`."""
        index = len(self.ends)
        self.received[index], self.events = [], {}
        self.going = threading.Event()
        self.going.set()

        def note(what):
            def note_it(event):
                with self.changed:
                    self.events[what] = {name: getattr(event, name) for name in dir(event) if not name.startswith("_")}
                    self.changed.notify_all()
            return note_it

        def receive(message):
            self.received[index].append(message.data)

        callbacks = SubscriptionEventCallbacks(**{what: note(what) for what in ["deadline", "liveliness", "message_lost", "matched"]})
        qos = QoSProfile(depth=1, deadline=Duration(nanoseconds=deadline_ms * 1_000_000))
        cls = ros_values.find("std_msgs/msg/String")
        self.ends.append(self.node.create_subscription(cls, topic, receive, qos, event_callbacks=callbacks))
        return index

    def happened(self, end, what):
        """Waits until it has happened; what was told of it last."""
        self.wait(lambda: what in self.events)
        return self.events[what]

    def liveliness(self, end, alive):
        """Waits until so many publishers are alive."""
        self.wait(lambda: self.events.get("liveliness", {}).get("alive_count") == alive)
        return self.events["liveliness"]

    def hold(self):
        """Has the executor do nothing until `go_on`."""
        held = threading.Event()

        def wait():
            held.set()
            self.going.wait()

        self.going.clear()
        self.spinning.create_task(wait)
        held.wait()

    def go_on(self):
        self.going.set()

    def destroy(self, end):
        one = self.ends[end]
        if end in self.received:
            self.node.destroy_subscription(one)
        else:
            self.node.destroy_publisher(one)

    def matched(self, end, count=1):
        """Waits until the end has found so many others."""
        return self.wait(lambda: self.others(end) == count)

    def others(self, end):
        """How many others the end has found."""
        one = self.ends[end]
        return one.get_publisher_count() if end in self.received else one.get_subscription_count()

    def wait(self, is_so):
        with self.changed:
            # Not everything that changes says so.
            while not is_so():
                self.changed.wait(0.005)

    def random(self, type, count, seed, data_bytes=0):
        """Random messages, not published: their bytes and values."""
        messages = random_messages(type, count, seed, data_bytes)
        return [[serialize_message(message).hex(), json.dumps(ros_values.plain_message(message))] for message in messages]

    def prepare_random(self, type, count, seed, data_bytes=0):
        """Makes random messages for `publish_prepared`; their values."""
        self.prepared = random_messages(type, count, seed, data_bytes)
        return [ros_values.plain_message(message) for message in self.prepared]

    def publish_prepared(self, end, count):
        """Publishes so many of them, which are then gone."""
        for message in self.prepared[:count]:
            self.ends[end].publish(message)
        del self.prepared[:count]

    def publish_text(self, end, texts):
        cls = ros_values.find("std_msgs/msg/String")
        for text in texts:
            self.ends[end].publish(cls(data=text))
        return len(texts)

    def publish_large(self, end, type, bytes, seed):
        """A message with so many bytes of data; its digest."""
        message = ros_values.find(type)()
        message.header.frame_id = f"frame {seed}"
        message.data = random.Random(seed).randbytes(bytes)
        message.width, message.height = bytes // 4, 1
        self.ends[end].publish(message)
        return digest_of(message)

    def take(self, end, count):
        """Waits for so many messages, and takes them."""
        received = self.received[end]
        self.wait(lambda: len(received) >= count)
        with self.changed:
            taken, received[:] = received[:], []
        return taken

    def incompatible_qos(self, end):
        """Waits until an end has been found that does not fit."""
        self.wait(lambda: end in self.incompatible)
        return self.incompatible[end]

    def wait_topic(self, topic, type):
        """Waits until the graph has a topic of this type; all types that it has."""
        types = lambda: dict(self.node.get_topic_names_and_types()).get(topic, [])
        self.wait(lambda: type in types())
        return types()

    def wait_node(self, name, there=True):
        """Waits until the graph has a node of this full name, or has not."""
        names = lambda: [f"{ns.rstrip('/')}/{name}" for name, ns in self.node.get_node_names_and_namespaces()]
        self.wait(lambda: (name in names()) == there)
        return names()

    def enclave(self, node):
        """Waits until the graph has a node of this full name; its enclave."""
        def enclaves():
            all = self.node.get_node_names_and_namespaces_with_enclaves()
            return {f"{ns.rstrip('/')}/{name}": enclave for name, ns, enclave in all}
        self.wait(lambda: node in enclaves())
        return enclaves()[node]

    def endpoints(self, topic):
        """Nodes and QoS of a topic's publishers and subscriptions."""
        def told(infos):
            return [[info.node_name, info.qos_profile.reliability.name, info.qos_profile.durability.name] for info in infos]
        node = self.node
        return [told(node.get_publishers_info_by_topic(topic)), told(node.get_subscriptions_info_by_topic(topic))]


def random_messages(type, count, seed, data_bytes=0):
    """Their field `data` has up to so many bytes, if it is to have some: few have nearly as many."""
    rng = random.Random(f"{seed} {type}")
    cls = ros_values.find(type)
    messages = [ros_values.random_message(rng, cls) for _ in range(count)]
    if data_bytes:
        for message in messages:
            message.data = array.array("B", rng.randbytes(round(data_bytes * rng.random() ** 4)))
    return messages


def digest_of(message):
    """Of a message with a header and much data."""
    data = hashlib.sha256(bytes(message.data)).hexdigest()
    return [message.header.frame_id, len(message.data), message.width, data]


def main(Peer=Peer):
    peer = Peer(sys.argv[1])
    print(json.dumps({"ok": "ready"}), flush=True)
    for line in sys.stdin:
        command = json.loads(line)
        try:
            answer = {"ok": getattr(peer, command.pop("do"))(**command)}
        except Exception as error:  # told to the one who asked
            answer = {"error": repr(error)}
        print(json.dumps(answer), flush=True)
    # Fast DDS removes its files from shared memory as the node ends; what may hang thereafter is left out.
    rclpy.shutdown()
    peer.spinner.join(5)
    peer.node.destroy_node()
    os._exit(0)


if __name__ == "__main__":
    main()
