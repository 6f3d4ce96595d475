# SPDX-License-Identifier: MIT OR Apache-2.0
"""A node on rmw_tautline of the prefix in AMENT_PREFIX_PATH, which its `.deb` has made."""

import os

import rclpy
from ament_index_python import get_resource

prefix = os.environ["AMENT_PREFIX_PATH"]
assert get_resource("rmw_typesupport", "rmw_tautline")[1] == prefix
rclpy.init()
libraries = [line.split()[-1] for line in open("/proc/self/maps") if "rmw_tautline" in line]
assert rclpy.get_rmw_implementation_identifier() == "rmw_tautline"
assert libraries and all(library.startswith(prefix) for library in libraries), libraries
print(rclpy.get_rmw_implementation_identifier(), "of", libraries[0])
