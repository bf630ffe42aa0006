"""The shared library of a wheel with the programs, for what runs in this process."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from ._session import Error

#: Beside this file in a wheel that has it; `CZ_ENV_LIBRARY` names another.
LIBRARY = "libcontrol_zones_env.so"


def load() -> ctypes.CDLL:
    """The library.

    Raises `Error` where there is none.
    """
    path = os.environ.get("CZ_ENV_LIBRARY") or str(Path(__file__).with_name(LIBRARY))
    try:
        return ctypes.CDLL(path)
    except OSError as error:
        raise Error(
            f"{error}; install a wheel with the programs, or build it with `cargo build --release -p control-zones-env` "
            f"and name target/release/{LIBRARY} in CZ_ENV_LIBRARY"
        ) from error
