# SPDX-License-Identifier: MIT OR Apache-2.0
"""A node of rclpy, and one in a process that Python's multiprocessing makes: both answer on /answer what they are asked on /ask.

Called with the method of starting, or with `exit`: then a forked child uses its parent's node, is told that it must not, and exits
as every program does.
"""

import multiprocessing
import os
import sys
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import SetBool


def matched(publisher):
    while publisher.get_subscription_count() == 0:
        time.sleep(0.005)


def node_of(role):
    """With a context of its own: one that was inherited belongs to the parent."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(role, context=context)
    node.answers = node.create_publisher(String, "/answer", 10)
    return context, node


def answer(role, context, node):
    matched(node.answers)
    text = lambda asked: String(data=f"{role} {os.getpid()} {asked.data}")
    node.create_subscription(String, "/ask", lambda asked: node.answers.publish(text(asked)), 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    executor.spin()


def child():
    answer("child", *node_of("child"))


def refused(use):
    """What a use of the parent's objects in a child says."""
    try:
        use()
    except Exception as error:
        if "this process was forked from" in str(error):
            return True
        print(repr(error), file=sys.stderr)
    return False


def use_and_exit(context, node):
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    client = node.create_client(SetBool, "/unserved")
    uses = [
        node.answers.assert_liveliness,
        client.service_is_ready,
        lambda: node.answers.publish(String(data="x")),
        lambda: node.create_publisher(String, "/other", 10),
        lambda: rclpy.create_node("other", context=context, use_global_arguments=False),
        executor.spin,
    ]
    pid = os.fork()
    if pid == 0:
        sys.exit(7 if all([refused(use) for use in uses]) else 1)
    _, status = os.waitpid(pid, 0)
    matched(node.answers)
    node.answers.publish(String(data=f"exited with {os.waitstatus_to_exitcode(status)}"))
    answer("parent", context, node)


if __name__ == "__main__":
    how = sys.argv[1]
    context, node = node_of("parent")
    if how == "exit":
        use_and_exit(context, node)
    multiprocessing.set_start_method(how)
    multiprocessing.Process(target=child).start()
    answer("parent", context, node)
