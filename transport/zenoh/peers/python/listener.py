# SPDX-License-Identifier: MIT OR Apache-2.0
"""ROS 2's listener, on zenoh-ros2-sdk: says what it hears on /chatter. listener.py PORT DOMAIN"""
import sys
import time

from zenoh_ros2_sdk import ROS2Subscriber

port, domain = sys.argv[1:]
subscriber = ROS2Subscriber(
    topic="/chatter", msg_type="std_msgs/msg/String", callback=lambda message: print(f"I heard: [{message.data}]", flush=True),
    msg_definition="string data\n", domain_id=int(domain), router_ip="127.0.0.1", router_port=int(port),
    type_hash="RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
)
print("listening", flush=True)
time.sleep(60)
