# SPDX-License-Identifier: MIT OR Apache-2.0
"""A node of zenoh-ros2-sdk that serves std_srvs/srv/SetBool, or asks it what each line of its input says.
service.py (serve|ask) PORT DOMAIN SERVICE HASH"""
import sys

from zenoh_ros2_sdk import ROS2ServiceClient, ROS2ServiceServer

role, port, domain, service, type_hash = sys.argv[1:]
arguments = dict(
    service_name=service, srv_type="std_srvs/srv/SetBool", request_definition="bool data\n",
    response_definition="bool success\nstring message\n", type_hash=type_hash, domain_id=int(domain), router_ip="127.0.0.1",
    router_port=int(port), node_name="their_node", namespace="/theirs",
)

if role == "serve":
    def answer(request):
        print("asked", request.data, flush=True)
        return server.response_msg_class(success=request.data, message="théirs" if request.data else "")

    server = ROS2ServiceServer(callback=answer, **arguments)
    print("started", flush=True)
    sys.stdin.read()
    server.close()
else:
    client = ROS2ServiceClient(timeout=20.0, **arguments)
    print("started", flush=True)
    for line in sys.stdin:
        response = client.call(data=line.strip() == "True")
        print("answer", response and (response.success, response.message), flush=True)
    client.close()
