"""The least a controller can be: hold 15 m/s. Run it with the shield on."""

import control_zones


def cruise(zone):
    return (15.0 - zone.v).clip(zone.run.spec.u_min_mps2, zone.run.spec.u_max_mps2)


control_zones.run(cruise)
