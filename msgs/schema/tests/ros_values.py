# SPDX-License-Identifier: MIT OR Apache-2.0
"""The ROS 2 side of ros_values.rs: random messages of every type, serialised by rclpy and as JSON.

Reads lines from standard input, writes lines to standard output. For each line `<type> <count> <seed>`: writes one line
`<cdr as hex> <json>` per message, or `skip <reason>`; then reads one line `<cdr as hex> <yaml as JSON string>` per
message and writes `ok` or what differs.
"""

import importlib
import json
import math
import random
import struct
import sys

import yaml
from rclpy.serialization import deserialize_message, serialize_message
from rosidl_parser import definition

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
INTEGERS = {
    "int8": (-(2**7), 2**7 - 1), "uint8": (0, 2**8 - 1), "int16": (-(2**15), 2**15 - 1), "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1), "int64": (-(2**63), 2**63 - 1), "uint64": (0, 2**64 - 1),
}
CHARACTERS = "abcXYZ019 _-:#'\"\\{}[],&*!|>%@`~=?.\n\téßλ中ハ😀𝄞"
WORDS = ["", "true", "no", "null", "~", "1", "-1.5", "0x1f", "1e5", ".nan", ".inf", "2001-01-01", "1:30", "- a", "a: b", "a #b",
         "---", "...", "<<", "=", " a", "a ", "'", "\"", "-", "?", "a\nb", "y", "0o7", "1_000", "+1", "12e03", "0b1",
         ".NaN", ".NAN", ".Inf", "-.INF", "2001-12-14t21:59:43", "010"]


def find(name):
    """The class of `package/kind/Name`."""
    package, kind, name = name.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    if kind == "msg":
        return getattr(module, name)
    base, _, part = name.partition("_")
    base = getattr(module, base)
    if kind == "srv" or part in ("Goal", "Result", "Feedback"):
        return getattr(base, part)
    if part == "FeedbackMessage":
        return base.Impl.FeedbackMessage
    service, _, part = part.partition("_")
    return getattr(getattr(base.Impl, service + "Service"), part)


def random_float(rng, bits):
    kind = rng.random()
    if kind < 0.1:
        return rng.choice([0.0, -0.0, math.nan, math.inf, -math.inf, 1.0, -1.5, 0.1 if bits == 64 else 0.5])
    if kind < 0.5:
        value = rng.uniform(-1000, 1000)
        return value if bits == 64 else struct.unpack("<f", struct.pack("<f", value))[0]
    value = struct.unpack("<d" if bits == 64 else "<f", rng.getrandbits(bits).to_bytes(bits // 8, "little"))[0]
    # Text has one NaN only.
    return math.nan if math.isnan(value) else value


def random_text(rng, bound):
    text = rng.choice(WORDS) if rng.random() < 0.3 else "".join(rng.choices(CHARACTERS, k=rng.randrange(20)))
    return text[:bound]


def random_value(rng, ty, depth):
    if isinstance(ty, definition.BasicType):
        name = ty.typename
        if name == "boolean":
            return rng.random() < 0.5
        if name == "octet":
            return bytes([rng.randrange(256)])
        if name == "float":
            return random_float(rng, 32)
        if name == "double":
            return random_float(rng, 64)
        low, high = INTEGERS["uint8" if name == "char" else name]
        return rng.choice([low, high, 0]) if rng.random() < 0.2 else rng.randint(low, high)
    if isinstance(ty, definition.AbstractGenericString):
        return random_text(rng, ty.maximum_size if ty.has_maximum_size() else None)
    if isinstance(ty, definition.NamespacedType):
        return random_message(rng, class_of(ty), depth + 1)
    if isinstance(ty, definition.Array):
        count = ty.size
    else:
        most = 3 if isinstance(ty.value_type, definition.NamespacedType) else 9
        most = max(0, most - 2 * depth) if most == 3 else most
        count = rng.randint(0, min(most, ty.maximum_size) if ty.has_maximum_size() else most)
    return [random_value(rng, ty.value_type, depth) for _ in range(count)]


def class_of(ty):
    return find("/".join([*ty.namespaces, ty.name]))


def random_message(rng, cls, depth=0):
    message = cls()
    for name, ty in fields(cls):
        setattr(message, name, random_value(rng, ty, depth))
    return message


def fields(cls):
    return zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES)


def plain(value, ty):
    """The value as JSON has it, with the strings that Tautline writes for NaN and infinities."""
    if isinstance(ty, definition.NamespacedType):
        return {name: plain(getattr(value, name), ty) for name, ty in fields(type(value))}
    if isinstance(ty, definition.AbstractNestedType):
        return [plain(element, ty.value_type) for element in value]
    if isinstance(ty, definition.AbstractGenericString):
        return value
    if ty.typename == "octet":
        return value[0]
    if ty.typename in ("float", "double"):
        value = float(value)
        if math.isnan(value):
            return "NaN"
        return value if math.isfinite(value) else "Infinity" if value > 0 else "-Infinity"
    return bool(value) if ty.typename == "boolean" else int(value)


def plain_message(message):
    return {name: plain(getattr(message, name), ty) for name, ty in fields(type(message))}


def matches(value, printed):
    """Whether what YAML holds is the value; a float32 is printed with fewer digits."""
    if isinstance(value, dict):
        return isinstance(printed, dict) and list(value) == list(printed) and all(
            matches(value[key], printed[key]) for key in value)
    if isinstance(value, list):
        return isinstance(printed, list) and len(value) == len(printed) and all(map(matches, value, printed))
    if isinstance(printed, float) and not math.isfinite(printed):
        return value == ("NaN" if math.isnan(printed) else "Infinity" if printed > 0 else "-Infinity")
    if isinstance(value, float):
        return isinstance(printed, float) and (value == printed or math.isclose(value, printed, rel_tol=1e-7, abs_tol=1e-44))
    return type(value) is type(printed) and value == printed


def main():
    for line in sys.stdin:
        name, count, seed = line.split()
        rng = random.Random(f"{seed} {name}")
        try:
            cls = find(name)
            messages = [random_message(rng, cls) for _ in range(int(count))]
            lines = [f"{serialize_message(message).hex()} {json.dumps(plain_message(message))}" for message in messages]
        except (ImportError, AttributeError) as error:
            print(f"skip {error!r}", flush=True)
            continue
        print("\n".join(lines), flush=True)
        verdict = "ok"
        for message in messages:
            cdr, printed = sys.stdin.readline().split(" ", 1)
            ours, theirs = plain_message(deserialize_message(bytes.fromhex(cdr), cls)), plain_message(message)
            # As text: NaN equals itself, 0.0 does not equal -0.0.
            if json.dumps(ours) != json.dumps(theirs):
                verdict = f"from our bytes: {json.dumps(ours)} instead of {json.dumps(theirs)}"
            printed = json.loads(printed)
            # Reading YAML takes longer than all the rest: one message of each type in ten.
            if printed and not matches(theirs, yaml.load(printed, LOADER)):
                verdict = f"from our YAML: {yaml.load(printed, LOADER)} instead of {theirs}: {printed}"
        print(verdict, flush=True)


if __name__ == "__main__":
    main()
