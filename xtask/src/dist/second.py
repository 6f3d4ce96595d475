# SPDX-License-Identifier: MIT OR Apache-2.0
"""A node on the library of rmw_tautline in a folder, which `.deb` or wheel have installed, sends itself a message."""

import os
import sys
import time

import rclpy
from ament_index_python import get_resource
from std_msgs.msg import String

folder = sys.argv[1]
if os.environ.get("AMENT_PREFIX_PATH") == folder:
    assert get_resource("rmw_typesupport", "rmw_tautline")[1] == folder
rclpy.init()
libraries = {line.split()[-1] for line in open("/proc/self/maps") if "librmw_tautline" in line}
assert rclpy.get_rmw_implementation_identifier() == "rmw_tautline"
assert libraries and all(library.startswith(folder) for library in libraries), libraries
node, received = rclpy.create_node("second"), []
node.create_subscription(String, "second", received.append, 1)
node.create_publisher(String, "second", 1).publish(String(data="here"))
end = time.monotonic() + 60
while not received and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=1)
print(received[0].data, "with", *libraries)
