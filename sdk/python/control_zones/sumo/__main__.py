"""`python3 -m control_zones.sumo`: the same as `cz sumo`."""

import sys

from .command import main

sys.exit(main())
