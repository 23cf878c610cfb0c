"""The switches that a render kernel is compiled from; wrt.renderer.features derives them from a scene."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Features:
    """Everything that changes the code of a render kernel. A switch that is False leaves no trace in it."""

    camera: str = "wrt.kernels.shade.cameras.perspective"  # The module of the camera kind.
    lens: bool = False
    blades: bool = False
    filter: bool = False  # The pixel filter is not the box.
    independent: bool = False  # Samples are independent random numbers.
    instances: bool = False
    spheres: bool = False
    smooth: bool = False
    textures: bool = False
    checkerboards: bool = False
    normal_maps: bool = False
    parameter_textures: bool = False  # Textures of roughness, metallic or transmission.
    cutout: bool = False
    blend: bool = False
    materials: tuple[str, ...] = ()  # The kinds of materials that the scene has.
    thin_glass: bool = False
    absorption: bool = False
    transmission: bool = False
    rough: bool = False
    highlight: bool = False
    schlick: bool = False
    emission: bool = False
    lights: tuple[str, ...] = ()  # The kinds of lights that the scene has.
    background: str = "constant"
    sky_light: bool = False  # The background is sampled as a light.
    ambient: bool = False
    tinted_shadows: bool = False
    transparent_shadows: bool = False
    reflection: bool = False
    refraction: bool = False
    stack_size: int = 1  # Paths of a sample that can wait, rounded up so that similar max_depths share a kernel.
    counting: bool = False  # Rays carry a label for the ray log (wrt.kernels.study.ray_log).

    @property
    def direct_light(self) -> bool:
        """True if lights or the background are sampled at a hit."""
        return bool(self.lights) or self.sky_light
