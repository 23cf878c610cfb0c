"""Images that a sensor fills."""

from dataclasses import dataclass
from typing import Any


@dataclass(eq=False)
class Images:
    """Images that `Sensor.trace` fills. It keeps the arrays that it is given: Warp arrays of the images' shape, or None if not wanted,
    on the structure's device.

    Attributes
    ----------
    depth, range : float32
        Distance of the hit along the sensor's axis, and from the sensor, in scene units; inf on a miss.
    t, u, v : float32; prim_id, object, instance, face : int32
        As in `Hits`.
    point, normal : vec3
        As in `Hits`; NaN on a miss.
    world : int32
        Index of the world that has the hit; 0 without worlds, -1 on a miss.
    origin, direction : vec3
        The rays.
    """

    depth: Any = None
    range: Any = None
    t: Any = None
    u: Any = None
    v: Any = None
    prim_id: Any = None
    object: Any = None
    instance: Any = None
    face: Any = None
    point: Any = None
    normal: Any = None
    world: Any = None
    origin: Any = None
    direction: Any = None
