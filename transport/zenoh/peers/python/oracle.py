# SPDX-License-Identifier: MIT OR Apache-2.0
"""Reads descriptions, one JSON object a line, and answers with what zenoh-ros2-sdk puts on the wire for each."""
import json
import sys

import xxhash
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr
from zenoh_ros2_sdk.qos import Duration, QosDurability, QosHistoryKind, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

for line in sys.stdin:
    d = json.loads(line)
    node = NodeEntity(d["domain"], d["zid"], d["node_id"], d["node"], d["namespace"])
    qos = QosProfile(
        reliability=QosReliability[d["reliability"]],
        durability=QosDurability[d["durability"]],
        history_kind=QosHistoryKind.KEEP_LAST,
        history_depth=d["depth"],
        deadline=Duration(d["deadline"][0], d["deadline"][1]),
    ).encode()
    dds = ros2_to_dds_type(d["type"])
    endpoint = EndpointEntity(node, d["id"], EntityKind(d["kind"]), d["topic"], dds, d["hash"], qos)
    token = endpoint_liveliness_keyexpr(endpoint)
    print(json.dumps({
        "node": node_liveliness_keyexpr(node),
        "token": token,
        "key": topic_keyexpr(d["domain"], d["topic"], dds, d["hash"]),
        "gid": xxhash.xxh3_128_digest(token.encode())[::-1].hex(),
        "attachment": Attachment(d["sequence"], d["stamp"], bytes.fromhex(d["gid"])).to_bytes().hex(),
    }))
