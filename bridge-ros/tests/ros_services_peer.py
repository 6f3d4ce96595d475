# SPDX-License-Identifier: MIT OR Apache-2.0
"""As ros_peer.py, and with services, actions and parameters."""

import threading
import time

import rclpy
from rclpy.logging import LoggingSeverity
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.parameter_service import ParameterService
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci
from test_msgs.srv import BasicTypes

import ros_peer
from ros_peer import ros_values

SERVICES = {"std_srvs/srv/SetBool": SetBool, "test_msgs/srv/BasicTypes": BasicTypes}


def set_bool(request, response):
    response.success = request.data
    response.message = "on" if request.data else "off"
    return response


def echo(request, response):
    for field in request.get_fields_and_field_types():
        setattr(response, field, getattr(request, field))
    return response


def silent(request, response):
    """Until the process is killed."""
    threading.Event().wait()


class Peer(ros_peer.Peer):
    executor = lambda self: MultiThreadedExecutor(4)

    def __init__(self, name):
        super().__init__(name)
        self.group = ReentrantCallbackGroup()

    def add(self, end):
        self.ends.append(end)
        return len(self.ends) - 1

    def done(self, future):
        self.wait(future.done)
        return future.result()

    def service(self, name, type, behaviour):
        callback = {"set_bool": set_bool, "echo": echo, "silent": silent}[behaviour]
        return self.add(self.node.create_service(SERVICES[type], name, callback, callback_group=self.group))

    def client(self, name, type):
        return self.add(self.node.create_client(SERVICES[type], name, callback_group=self.group))

    def available(self, end, is_so=True):
        """Waits until the client's service is there, or is not."""
        return self.wait(lambda: self.ends[end].service_is_ready() == is_so)

    def call(self, end, requests):
        """Waits for the service; sends all requests before it waits for the first response."""
        client = self.ends[end]
        self.wait(client.service_is_ready)
        return [ros_values.plain_message(self.done(future)) for future in [
            client.call_async(fill(client.srv_type.Request(), request)) for request in requests]]

    def ask(self, end, request):
        """Sends a request whose response is looked for with `answered`."""
        client = self.ends[end]
        self.asked = client.call_async(fill(client.srv_type.Request(), request))

    def flood(self, end, request, count):
        """Sends so many requests, as fast as they are taken from this process, and waits for none."""
        client = self.ends[end]
        self.wait(client.service_is_ready)
        self.flooded = []
        for index in range(count):
            self.flooded.append(client.call_async(fill(client.srv_type.Request(), request)))
            if index % 5 == 4:
                time.sleep(0.001)

    def answered(self):
        return self.asked.done()

    def ask_all(self, end, requests):
        """Sends requests, whether there is a service or not; `all_answered` waits for the responses."""
        client = self.ends[end]
        self.asked = [client.call_async(fill(client.srv_type.Request(), request)) for request in requests]

    def all_answered(self):
        return [ros_values.plain_message(self.done(future)) for future in self.asked]

    def action_server(self, name):
        """Fibonacci, slowly; negative orders are rejected."""
        def execute(goal):
            sequence = [0, 1]
            while len(sequence) <= goal.request.order:
                if goal.is_cancel_requested:
                    goal.canceled()
                    return Fibonacci.Result(sequence=[-1])
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
                time.sleep(0.02)
                sequence.append((sequence[-1] + sequence[-2]) % 1000)
            goal.succeed()
            return Fibonacci.Result(sequence=sequence)

        accept = lambda goal: GoalResponse.REJECT if goal.order < 0 else GoalResponse.ACCEPT
        return self.add(ActionServer(
            self.node, Fibonacci, name, execute, goal_callback=accept, callback_group=self.group,
            cancel_callback=lambda goal: CancelResponse.ACCEPT))

    def action_client(self, name):
        # In a group of its own: several threads would run the callbacks of feedback in any order.
        return self.add(ActionClient(self.node, Fibonacci, name, callback_group=MutuallyExclusiveCallbackGroup()))

    def goal(self, end, order, cancel_after=None, told=0):
        """Sends a goal; cancels it after so much feedback, or waits for as much as is told. What became of it."""
        client, feedback = self.ends[end], []
        self.wait(client.server_is_ready)

        def hear(message):
            with self.changed:
                feedback.append(list(message.feedback.sequence))
                self.changed.notify_all()

        goal = self.done(client.send_goal_async(Fibonacci.Goal(order=order), feedback_callback=hear))
        if not goal.accepted:
            return {"accepted": False}
        result = goal.get_result_async()
        if cancel_after is not None:
            self.wait(lambda: len(feedback) >= cancel_after)
            cancelling = len(self.done(goal.cancel_goal_async()).goals_canceling)
        else:
            cancelling = 0
        result = self.done(result)
        # Of a result and feedback that wait together, rclpy hands over the result first.
        self.wait(lambda: len(feedback) >= told)
        return {"accepted": True, "status": result.status, "sequence": list(result.result.sequence),
                "feedback": feedback, "cancelling": cancelling}

    def serve_parameters(self, values):
        """Declares parameters of this node, and has them got and set by others from now on."""
        for name, value in values.items():
            self.node.declare_parameter(name, value)
        self.parameter_service = ParameterService(self.node)

    def parameters(self, node):
        """A client of a node's parameters, once its services are there."""
        client = AsyncParameterClient(self.node, node, callback_group=self.group)
        self.wait(client.services_are_ready)
        return self.add(client)

    def get_parameters(self, end, names):
        values = self.done(self.ends[end].get_parameters(names)).values
        return [ros_values.plain_message(value) for value in values]

    def set_parameters(self, end, values):
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        results = self.done(self.ends[end].set_parameters(parameters)).results
        return [[result.successful, result.reason] for result in results]

    def list_parameters(self, end):
        return sorted(self.done(self.ends[end].list_parameters()).result.names)

    def describe_parameters(self, end, names):
        descriptors = self.done(self.ends[end].describe_parameters(names)).descriptors
        return [ros_values.plain_message(descriptor) for descriptor in descriptors]

    def publish_clock(self, end, sec, nanosec=0):
        message = ros_values.find("rosgraph_msgs/msg/Clock")()
        message.clock.sec, message.clock.nanosec = sec, nanosec
        self.ends[end].publish(message)

    def publish_transform(self, end, child, x):
        message = ros_values.find("geometry_msgs/msg/TransformStamped")()
        message.child_frame_id, message.transform.translation.x = child, x
        self.ends[end].publish(message)

    def lifecycle_node(self, name):
        self.living = LifecycleNode(name)
        self.spinning.add_node(self.living)

    def logging_node(self, name, line):
        """A node whose levels can be set, and which has logged a line."""
        self.logging = rclpy.create_node(name, enable_logger_service=True)
        self.spinning.add_node(self.logging)
        self.logging.get_logger().warning(line)

    def logs_debug(self):
        return self.logging.get_logger().is_enabled_for(LoggingSeverity.DEBUG)

    def change_state(self, node, transition):
        """Asks a lifecycle node to change its state: whether it did, and which it has."""
        change = self.node.create_client(ChangeState, f"{node}/change_state", callback_group=self.group)
        state = self.node.create_client(GetState, f"{node}/get_state", callback_group=self.group)
        self.wait(lambda: change.service_is_ready() and state.service_is_ready())
        request = ChangeState.Request()
        request.transition.id = transition
        is_changed = self.done(change.call_async(request)).success
        return [is_changed, self.done(state.call_async(GetState.Request())).current_state.label]

    def simulated_node(self, name):
        self.simulated = rclpy.create_node(name, parameter_overrides=[Parameter("use_sim_time", value=True)])
        self.spinning.add_node(self.simulated)

    def simulated_time(self, at_least):
        """The simulated node's time, once it is that late."""
        now = lambda: self.simulated.get_clock().now().nanoseconds
        self.wait(lambda: now() >= at_least)
        return now()

    def nodes(self, name, count):
        """So many nodes as rclpy makes them by default, each with a subscription to /all."""
        self.heard = []
        self.many = [rclpy.create_node(f"{name}_{n}") for n in range(count)]
        for node in self.many:
            node.create_subscription(String, "/all", lambda message: self.heard.append(message.data), 10)
            self.spinning.add_node(node)

    def passing_node(self, name):
        """A node as rclpy makes it by default, until `pass_by`."""
        self.passing = rclpy.create_node(name)

    def pass_by(self):
        self.passing.destroy_node()
        self.passing = None

    def all_heard(self, text):
        """Waits until each of these nodes has heard it."""
        return self.wait(lambda: self.heard.count(text) == len(self.many))

    def services_of(self, node, namespace="/"):
        return sorted(name for name, _ in self.node.get_service_names_and_types_by_node(node, namespace))


def fill(message, values):
    for field, value in values.items():
        is_octet = isinstance(getattr(message, field), bytes)
        setattr(message, field, bytes([value]) if is_octet else value)
    return message


if __name__ == "__main__":
    ros_peer.main(Peer)
