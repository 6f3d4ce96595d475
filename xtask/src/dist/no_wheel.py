# SPDX-License-Identifier: MIT OR Apache-2.0
"""What pip runs where it takes no wheel: it says why, and builds nothing."""

import platform
import sys


def refuse(*_, **__):
    machine, (library, version) = platform.machine(), platform.libc_ver()
    needed = tuple(map(int, "@GLIBC@".split(".")))
    if sys.platform != "linux" or machine not in "@MACHINES@".split(" or "):
        reason = f"this is {sys.platform} on {machine}"
    elif library != "glibc":
        reason = "this system's C library is another one"
    elif tuple(map(int, version.split(".")[:2])) < needed:
        reason = f"this system has glibc {version}"
    else:
        sys.exit("This pip is too old for the wheel of @NAME@ @VERSION@: python3 -m pip install --upgrade pip")
    sys.exit(
        f"@NAME@ @VERSION@ is built for Linux on @MACHINES@ with glibc @GLIBC@ or newer (Ubuntu 22.04, Debian 12), and {reason}: "
        "build it from source, https://github.com/tautline/tautline"
    )


build_wheel = build_sdist = get_requires_for_build_wheel = prepare_metadata_for_build_wheel = refuse
