"""The switches that a render kernel is compiled from. wrt.renderer.features says which a scene needs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Features:
    """Everything that changes the code of a kernel; what is False leaves no trace in it.

    camera: the module of its device function; lens, blades, filter: the camera's; independent: the samples are random numbers;
    instances, spheres, smooth, textures, checkerboards, normal_maps, parameter_textures (of roughness and the like), cutout,
    blend: the surfaces'; materials, lights, background: the kinds there are, by name; derived: reflection, refraction,
    transmission, transparent_shadows, sky_light, highlight. stack_size: room for the rays that can be pending, in whole steps,
    so that neighbouring depths share a kernel. counting: rays carry the label that a log keeps (wrt.kernels.study.ray_log).
    """

    camera: str = "wrt.kernels.shade.cameras.perspective"
    lens: bool = False
    blades: bool = False
    filter: bool = False
    independent: bool = False
    instances: bool = False
    spheres: bool = False
    smooth: bool = False
    textures: bool = False
    checkerboards: bool = False
    normal_maps: bool = False
    parameter_textures: bool = False
    cutout: bool = False
    blend: bool = False
    materials: tuple[str, ...] = ()
    thin_glass: bool = False
    absorption: bool = False
    transmission: bool = False
    rough: bool = False
    highlight: bool = False
    schlick: bool = False
    emission: bool = False
    lights: tuple[str, ...] = ()
    background: str = "constant"
    sky_light: bool = False
    ambient: bool = False
    tinted_shadows: bool = False
    transparent_shadows: bool = False
    reflection: bool = False
    refraction: bool = False
    stack_size: int = 1
    counting: bool = False

    @property
    def direct_light(self) -> bool:
        """Whether lights are asked for at a hit."""
        return bool(self.lights) or self.sky_light
