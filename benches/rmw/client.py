# SPDX-License-Identifier: MIT OR Apache-2.0
"""One end of round trips in rclpy: `client.py near|far TOPIC BYTES MILLISECONDS CORE PRIORITY`.

It measures and says what bench-rmw's own ends do.
"""

import array
import json
import os
import resource
import struct
import sys
import threading
import time

ROLE, TOPIC = sys.argv[1:3]
BYTES, MILLISECONDS, CORE, PRIORITY = map(int, sys.argv[3:])
os.sched_setaffinity(0, {CORE})
if PRIORITY:
    # The RMW's threads inherit it.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))

import rclpy  # noqa: E402
from geometry_msgs.msg import Twist  # noqa: E402
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from std_msgs.msg import UInt8MultiArray  # noqa: E402

STRUCT_BYTES = 48
# Seconds for an answer, for one until there was any, and for the first one.
PATIENCE, CONNECTING, NEVER = 0.5, 0.05, 20.0
WARM_UP = 30


def say(line):
    print(json.dumps(line), flush=True)


def page_faults():
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt


def end_with_starter():
    while os.read(0, 1 << 10):
        pass
    rclpy.try_shutdown()


class End:
    """A publisher, a subscription and an executor with one thread."""

    def __init__(self):
        self.is_near = ROLE == "near"
        self.is_struct = BYTES <= STRUCT_BYTES
        self.message = Twist() if self.is_struct else UInt8MultiArray(data=array.array("B", bytes(BYTES)))
        self.answer = 0
        node = rclpy.create_node(ROLE)
        there, back = TOPIC + "/there", TOPIC + "/back"
        to, source = (there, back) if self.is_near else (back, there)
        self.publisher = node.create_publisher(type(self.message), to, QoSProfile(depth=10))
        node.create_subscription(type(self.message), source, self.arrive, QoSProfile(depth=10))
        # Only so that a wait ends: one with a time-out makes a timer each time.
        node.create_timer(CONNECTING, lambda: None)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(node)

    def arrive(self, message):
        if not self.is_near:
            self.publisher.publish(message)
        elif self.is_struct:
            self.answer = int(message.linear.x)
        else:
            self.answer = struct.unpack_from("<Q", message.data)[0]

    def send(self, number):
        if self.is_struct:
            self.message.linear.x = float(number)
        else:
            struct.pack_into("<Q", self.message.data, 0, number)
        self.publisher.publish(self.message)

    def round_trips(self):
        budget_ns = MILLISECONDS * 10**6
        created = time.monotonic_ns()
        connected = since = None
        times, number, answers, lost, faults = [], 0, 0, 0, 0
        while True:
            start = time.monotonic_ns()
            if since is not None and start - since >= budget_ns:
                faults = page_faults() - faults
                say({"Measured": {"times_ns": times, "lost": lost, "faults": faults, "seconds": (start - since) / 1e9}})
                return
            if since is None and answers >= WARM_UP and start - connected >= budget_ns / 8:
                since, faults = start, page_faults()
            number += 1
            end = start + (PATIENCE if connected else CONNECTING) * 1e9
            self.send(number)
            while self.answer != number and time.monotonic_ns() < end:
                self.executor.spin_once()
            now = time.monotonic_ns()
            if self.answer == number:
                connected = connected or now
                answers += 1
                if since is not None:
                    times.append((now - start) // 2)
            elif since is not None:
                lost += 1
            elif not connected and now - created > NEVER * 1e9:
                sys.exit(f"the other end did not answer in {NEVER} s")


rclpy.init()
threading.Thread(target=end_with_starter, daemon=True).start()
END = End()
if END.is_near:
    END.round_trips()
else:
    say({"Ready": None})
    try:
        END.executor.spin()
    except ExternalShutdownException:
        pass
