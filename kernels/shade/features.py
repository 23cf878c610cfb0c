"""The switches that a render kernel is compiled from; wrt.renderer.plan derives them from a scene."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Features:
    """Everything that changes the code of a render kernel. A switch that is False adds no code."""

    camera: str = "wrt.kernels.shade.cameras.perspective"  # The module of the camera kind.
    lens: bool = False  # The camera has an aperture.
    blades: bool = False  # The aperture is a polygon.
    filter: bool = False  # The pixel filter is not the box.
    independent: bool = False  # Samples are independent random numbers.
    instances: bool = False
    spheres: bool = False
    smooth: bool = False  # Some mesh has vertex normals.
    textures: bool = False  # Some texture is a picture.
    checkerboards: bool = False
    normal_maps: bool = False
    parameter_textures: bool = False  # Textures of roughness, metallic or transmission.
    cutout: bool = False  # Some material has the alpha mode "mask".
    blend: bool = False  # Some material has the alpha mode "blend".
    materials: tuple[str, ...] = ()  # The kinds of materials that the scene has.
    thin_glass: bool = False
    absorption: bool = False  # Some clear material absorbs light.
    transmission: bool = False  # Some material of kind metallic_roughness transmits light.
    rough: bool = False  # Some material has microfacets, which blur reflections.
    highlight: bool = False  # Scatter.highlight is used.
    specular: bool = False  # Some dielectric's reflectance differs from that of its index.
    clearcoat: bool = False  # Some material has a clear coat.
    schlick: bool = False  # Schlick's approximation replaces Fresnel's formulas of dielectrics.
    emission: bool = False  # Some material emits light.
    lights: tuple[str, ...] = ()  # The kinds of lights that the scene has.
    background: str = "constant"  # The kind of the background.
    sky_light: bool = False  # The background is sampled as a light.
    ambient: bool = False  # The ambient term is not 0, and is not occluded.
    ambient_occlusion: bool = False  # Shadow rays sample how much of the ambient term nearby surfaces occlude.
    tinted_shadows: bool = False  # Shadow rays pass solid glass straight.
    transparent_shadows: bool = False  # Shadow rays pass transparent surfaces.
    reflection: bool = False  # Surfaces make reflected paths.
    refraction: bool = False  # Surfaces make refracted paths.
    stack_size: int = 1  # Number of a sample's paths that can wait, rounded up so that similar max_depths share a kernel.
    counting: bool = False  # Rays carry a label for the ray log (wrt.kernels.study.ray_log).
    recording: bool = False  # Everything that happens to a pixel's rays is recorded (wrt.kernels.loops.record).

    @property
    def direct_light(self) -> bool:
        """True if lights, the background or the ambient term are sampled at a hit."""
        return bool(self.lights) or self.extra_lights > 0

    @property
    def extra_lights(self) -> int:
        """Number of lights after the scene's: light Lighting.count is the background, if sampled; the last one is the ambient term."""
        return int(self.sky_light) + int(self.ambient_occlusion)
