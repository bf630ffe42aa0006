"""Puts programs and libraries of a release build into the wheel where `CZ_PROGRAMS` names their directory.

Without it the wheel is pure Python, so that `pip install ./sdk/python` needs no Rust.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

#: What `control_zones.env` loads.
LIBRARY = "libcontrol_zones_env.so"
#: What controllers in C and C++ are linked with, which `cz sdk install` finds in `lib` beside the folder of the programs.
C_LIBRARY = "libcontrol_zones_c.so"
PROGRAMS = ("cz", "cz-world", "cz-coord", "cz-ctrl", "cz-export", "cz-report", "cz-sweep", "cz-view", "cz-top")


class Programs(BuildHookInterface):  # type: ignore[type-arg]
    """The hook that hatchling finds here."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Adds stripped copies of the programs, and the tag of the platforms they run on."""
        named = os.environ.get("CZ_PROGRAMS")
        if not named or version == "editable":
            return
        found = [Path(named).resolve() / program for program in (*PROGRAMS, LIBRARY, C_LIBRARY)]
        missing = [path.name for path in found if not path.is_file()]
        if missing:
            raise SystemExit(
                f"CZ_PROGRAMS={named}: {', '.join(missing)} not there; expected the directory of "
                "`cargo build --release --workspace --bins` and `-p control-zones-env -p control-zones-c`, such as target/release"
            )
        self._copies = tempfile.TemporaryDirectory(prefix="cz-wheel-")
        glibc = 17
        for path in found:
            copy = Path(self._copies.name) / path.name
            shutil.copy(path, copy)
            subprocess.run(["strip", str(copy)], check=True)
            if path.name == LIBRARY:
                build_data["force_include"][str(copy)] = f"control_zones/{LIBRARY}"
            elif path.name == C_LIBRARY:
                build_data["shared_data"][str(copy)] = f"lib/{C_LIBRARY}"
            else:
                build_data["shared_scripts"][str(copy)] = path.name
            glibc = max(glibc, *needed_glibc(copy))
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-manylinux_2_{glibc}_{platform.machine()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the copies."""
        if hasattr(self, "_copies"):
            self._copies.cleanup()


def needed_glibc(program: Path) -> list[int]:
    """The minor versions of glibc 2 that a program names among the symbols it asks for."""
    return [int(minor) for minor in re.findall(rb"\0GLIBC_2\.(\d+)(?=[.\0])", program.read_bytes())]
