# SPDX-License-Identifier: MIT OR Apache-2.0
"""Callbacks that do nothing, so that all that their thread does is overhead of rclpy's executor, for `taut report --overheads`.

    TAUT_OVERHEADS=empty python3 empty_callbacks.py [subscriptions] [messages]

Give it as many subscriptions as your executor has. It prints the processor time of its thread, and ends with its input.
"""

import os
import sys
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String


def publish(topics: list[str]) -> None:
    """Publishes on each topic in turn until it is killed."""
    rclpy.init()
    node = rclpy.create_node("source")
    publishers = [node.create_publisher(String, topic, 10) for topic in topics]
    while True:
        for publisher in publishers:
            publisher.publish(String(data="nothing"))
            time.sleep(0.002)


def main() -> None:
    given = [int(text) for text in sys.argv[1:]]
    count, messages = given + [5, 500][len(given) :]
    topics = [f"/empty/t{number}" for number in range(count)]
    child = os.fork()
    if child == 0:
        publish(topics)
    rclpy.init()
    node = rclpy.create_node("empty")
    remaining = messages

    def heard(_: String) -> None:
        nonlocal remaining
        remaining -= 1

    subscriptions = [node.create_subscription(String, topic, heard, 10) for topic in topics]
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    start = time.thread_time_ns()
    while remaining > 0:
        executor.spin_once()
    print(f"{messages} callbacks of {len(subscriptions)} subscriptions, {time.thread_time_ns() - start} ns", flush=True)
    os.kill(child, 9)
    os.waitpid(child, 0)
    sys.stdin.read()


main()
