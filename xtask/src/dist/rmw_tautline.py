# SPDX-License-Identifier: MIT OR Apache-2.0
"""rmw_tautline for Python: rcl of the wheels is linked to another RMW, whose place a library takes that is loaded before."""

import ctypes
import os
import sys
from importlib import metadata

VERSION = "@VERSION@"
# The RMW's interface differs between distributions, and so do its structs.
KNOWN = {"6.1": "humble", "7.1": "iron", "7.3": "jazzy", "7.8": "kilted"}
LIBRARY = os.path.join(os.path.dirname(__file__), "{}", "librmw_tautline.so")


def load():
    """Loads the library of the wheels' ROS 2, or returns why not and what to do."""
    try:
        version = metadata.version("ros-rmw")
    except metadata.PackageNotFoundError:
        return "the wheels of ROS 2 are missing: pip install 'ros-jazzy-rclpy[fastrtps]'"
    name = KNOWN.get(".".join(version.split(".")[:2]), "another distribution")
    sourced = os.environ.get("ROS_DISTRO") or name
    if sourced != name:
        return f"ROS_DISTRO is {sourced}, but ros-rmw {version} is of {name}: use packages of one distribution"
    built = [each for each in KNOWN.values() if os.path.exists(LIBRARY.format(each))]
    if name not in built:
        return f"it is built for {' and '.join(built)}, and ros-rmw {version} is of {name}: build it from source for that one"
    try:
        ctypes.CDLL(LIBRARY.format(name), ctypes.RTLD_GLOBAL)
    except OSError as error:
        return f"{error}: pip install --force-reinstall 'ros-{name}-rclpy[fastrtps]'"
    return None


# At the import, for Python may read the file that imports this twice. Without the library, rcl refuses to start: it is not the RMW that
# RMW_IMPLEMENTATION asks for.
reason = load()
if reason:
    print(f"rmw_tautline {VERSION} is not loaded: {reason}, or unset RMW_IMPLEMENTATION", file=sys.stderr)
