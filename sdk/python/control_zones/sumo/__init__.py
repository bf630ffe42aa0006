"""SUMO as the world of a run: `cz sumo`, or `python3 -m control_zones.sumo`.

Needs libsumo, sumolib and eclipse-sumo: `pip install "control-zones[sumo]"`. docs/sumo.md says what is there.
"""
