# SPDX-License-Identifier: MIT OR Apache-2.0
"""rmw_tautline for Python: rcl of the wheels is linked to another RMW, whose place a library takes that is loaded before."""

import ctypes
import os
import sys
from importlib import metadata

VERSION = "@VERSION@"
# The RMW's interface differs between distributions, and so do its structs.
DISTRIBUTION, INTERFACE = "jazzy", "7.3"
KNOWN = {"6.1": "humble", "7.1": "iron", INTERFACE: DISTRIBUTION, "7.8": "kilted"}


def other_distribution():
    """The name of a ROS 2 that the library is not built for."""
    sourced = os.environ.get("ROS_DISTRO") or DISTRIBUTION
    if sourced != DISTRIBUTION:
        return f"{sourced} (ROS_DISTRO)"
    version = metadata.version("ros-rmw")
    interface = ".".join(version.split(".")[:2])
    return None if interface == INTERFACE else f"{KNOWN.get(interface, 'another distribution')} (ros-rmw {version})"


def load():
    """Loads the library, or returns why not and what to do."""
    try:
        other = other_distribution()
        if other:
            return f"it is built for ROS 2 {DISTRIBUTION}, and this is {other}: build it from source for that one"
        ctypes.CDLL(os.path.join(os.path.dirname(__file__), "librmw_tautline.so"), ctypes.RTLD_GLOBAL)
    except metadata.PackageNotFoundError:
        return "the wheels of ROS 2 are missing: pip install 'ros-jazzy-rclpy[fastrtps]'"
    except OSError as error:
        return f"{error}: pip install --force-reinstall ros-rmw ros-fastcdr"
    return None


# At the import, for Python may read the file that imports this twice. Without the library, rcl refuses to start: it is not the RMW that
# RMW_IMPLEMENTATION asks for.
reason = load()
if reason:
    print(f"rmw_tautline {VERSION} is not loaded: {reason}, or unset RMW_IMPLEMENTATION", file=sys.stderr)
