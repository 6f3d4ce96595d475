# SPDX-License-Identifier: MIT OR Apache-2.0
# rmw_tautline's `.deb` where ROS 2 is installed: after the commands of docs/rmw.md. Its libraries are those of the wheels, for Debian has none.
say "rmw_tautline where ROS 2 is installed"
pip uninstall --quiet --yes rmw-tautline
sudo dpkg --force-depends --install target/dist/ros-jazzy-rmw-tautline_*_"$(dpkg --print-architecture)".deb
AMENT_PREFIX_PATH=/opt/ros/jazzy LD_LIBRARY_PATH=robot/lib LD_PRELOAD=/opt/ros/jazzy/lib/librmw_tautline.so python3 -c '
import rclpy
from ament_index_python import get_resource
assert get_resource("rmw_typesupport", "rmw_tautline")[1] == "/opt/ros/jazzy"
rclpy.init()
print(rclpy.get_rmw_implementation_identifier(), "of", [line.split()[-1] for line in open("/proc/self/maps") if "rmw_tautline" in line][0])'
sudo dpkg --purge ros-jazzy-rmw-tautline
if [ -e /opt/ros ]; then echo "/opt/ros is still there"; exit 1; fi
