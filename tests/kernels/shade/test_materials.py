"""Fresnel's formulas against closed forms and complex arithmetic, and the scattering of each kind of material."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.fresnel import fresnel
from tests.refused import refused

from tests.kernel_tools import DEVICE, floats, launch, rounded, sobol_like, unit, vec2s, vec3s, zeros  # isort: skip
import warp as wp

from wrt.core.device import upload
from wrt.kernels import structs
from wrt.kernels.shade import materials
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.materials import (
    Scatter,
    blinn_phong,
    fresnel_conductor,
    fresnel_dielectric,
    fresnel_schlick,
    fresnel_tint,
    make_scatter,
)
from wrt.kernels.shade.sampling import cap_point
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import kernel
from wrt.renderer.upload import TextureTable, material_records
from wrt.scene.materials import CONDUCTORS, MATERIALS, Material, MaterialKind


@kernel
def fresnel_kernel(cosine: wp.array(dtype=wp.float32), eta: float, k: float, f0: wp.vec3, exact: wp.array(dtype=wp.float32),
                   schlick: wp.array(dtype=wp.float32), metal: wp.array(dtype=wp.float32), tint: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    exact[i] = fresnel_dielectric(cosine[i], eta)
    schlick[i] = fresnel_schlick(cosine[i], eta)
    metal[i] = fresnel_conductor(cosine[i], eta, k)
    tint[i] = fresnel_tint(cosine[i], f0)


@kernel
def highlight_kernel(wi: wp.array(dtype=wp.vec3), wo: wp.vec3, exponent: float, out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = blinn_phong(wp.vec3(0.0, 0.0, 1.0), wi[i], wo, exponent)


def reflectances(cosine, eta, k=0.0, f0=(0.0, 0.0, 0.0)):
    """Return the reflectances: exact, Schlick, conductor, each (N,), and tint (N, 3), in float64."""
    cosine = np.atleast_1d(cosine)
    outs = [zeros(len(cosine)) for _ in range(3)] + [zeros(len(cosine), wp.vec3)]
    launch(fresnel_kernel, len(cosine), floats(cosine), float(eta), float(k), wp.vec3(*f0), *outs)
    return [out.numpy().astype(np.float64) for out in outs]


ANGLES = np.radians(np.concatenate([np.linspace(0.0, 89.0, 200), [89.5, 89.9, 89.99]]))


@pytest.mark.parametrize("eta", [1.0, 1.0003, 1.33, 1.5, 2.42, 10.0, 1.0 / 1.33, 1.0 / 1.5, 0.1])
def test_dielectric_against_complex_arithmetic(eta):
    cosine = rounded(np.cos(ANGLES))
    found = reflectances(cosine, eta)[0]
    sine = np.sqrt(1.0 - cosine**2)
    reflected = sine / eta >= 1.0 - 1e-6
    expected = fresnel(cosine, eta)
    assert np.abs(found - expected)[~reflected].max() < 5e-5
    assert (found[sine / eta > 1.0 + 1e-6] == 1.0).all()
    assert ((found >= 0.0) & (found <= 1.0)).all()


def test_a_boundary_reflects_the_same_from_both_sides():
    outside = np.cos(np.radians(np.linspace(0.0, 85.0, 100)))
    inside = np.sqrt(1.0 - (1.0 - outside**2) / 1.5**2)
    assert np.abs(reflectances(outside, 1.5)[0] - reflectances(inside, 1.0 / 1.5)[0]).max() < 1e-5
    assert np.abs(reflectances(outside, 1.5)[1] - reflectances(inside, 1.0 / 1.5)[1]).max() < 1e-5


@pytest.mark.parametrize(("eta", "bound"), [(1.33, 0.06), (1.5, 0.036), (1.8, 0.05)])
def test_schlick_stays_near_the_exact_curve(eta, bound):
    cosine = np.cos(np.radians(np.linspace(0.0, 89.9, 400)))
    exact, schlick, _, _ = reflectances(cosine, eta)
    r = ((eta - 1.0) / (eta + 1.0)) ** 2
    assert np.abs(schlick - (r + (1.0 - r) * (1.0 - cosine) ** 5)).max() < 1e-6
    assert exact[0] == pytest.approx(schlick[0], abs=1e-6)
    assert 0.02 < np.abs(exact - schlick).max() < bound  # The largest error is near 85 degrees.


@pytest.mark.parametrize("metal", CONDUCTORS)
def test_metals_against_complex_arithmetic(metal):
    cosine = rounded(np.cos(ANGLES))
    for eta, k in zip(*CONDUCTORS[metal], strict=True):
        found = reflectances(cosine, eta, k)[2]
        assert np.abs(found - fresnel(cosine, complex(eta, k))).max() < 2e-6
        assert found[0] == pytest.approx(((eta - 1) ** 2 + k * k) / ((eta + 1) ** 2 + k * k), abs=1e-6)


@pytest.mark.parametrize(("eta", "k"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.5, 0.0), (1000.0, 1000.0), (0.001, 0.001),
                                        (0.0, 1000.0), (1e-3, 5.0), (0.2, 0.0)])
def test_metals_of_any_index_that_a_scene_may_have(eta, k):
    cosine = rounded(np.concatenate([np.cos(ANGLES), [0.0, 1.0, 1e-4, 0.5]]))
    found = reflectances(cosine, eta, k)[2]
    assert np.isfinite(found).all()
    assert (found >= -1e-6).all() and (found <= 1.0 + 1e-5).all()
    if (eta, k) not in ((0.0, 0.0), (1.0, 0.0)):
        inside = np.abs(np.sqrt(1.0 - cosine**2) - eta) > 1e-3  # Away from the critical angle, where the curve is vertical.
        assert np.abs(found - fresnel(cosine, complex(eta, k)))[inside].max() < 5e-4


def test_tint_runs_from_f0_to_white():
    f0 = np.array([0.9, 0.5, 0.1])
    tint = reflectances([1.0, 0.5, 0.0], 1.5, f0=f0)[3]
    assert np.allclose(tint[0], f0) and np.allclose(tint[2], 1.0)
    assert np.allclose(tint[1], f0 + (1.0 - f0) / 32.0, atol=1e-6)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 10.0, 100.0, 1e4, 1e5])
def test_highlight_is_normalised(exponent):
    # Quadrature over the half vector's angle h: the hemispherical reflectance at normal incidence must be 1.
    # The direction wi is at the angle 2 h. Its solid angle is 4 cos(h) times that of the half vector.
    x, w = np.polynomial.legendre.leggauss(300)
    reach = min(np.pi / 4.0, 12.0 / np.sqrt(exponent + 1.0))
    h, w = 0.5 * reach * (x + 1.0), 0.5 * reach * w
    wi = np.stack([np.sin(2.0 * h), 0.0 * h, np.cos(2.0 * h)], axis=1)
    value = zeros(len(h))
    launch(highlight_kernel, len(h), vec3s(wi), wp.vec3(0.0, 0.0, 1.0), float(exponent), value)
    solid_angle = 2.0 * np.pi * np.sin(h) * 4.0 * np.cos(h)
    reflectance = (value.numpy() * np.cos(2.0 * h) * solid_angle * w).sum()
    assert reflectance == pytest.approx(1.0, abs=2e-3)
    assert reflectance <= 1.0 + (1e-5 if exponent < 1e3 else 2e-3)  # Only the rounding of power may exceed 1.


# --- scatter ----------------------------------------------------------------------------------------------------------


EVERYTHING = Features(materials=tuple(MATERIALS), thin_glass=True, transmission=True, rough=True, highlight=True, reflection=True,
                      refraction=True)


COATED = replace(EVERYTHING, specular=True, clearcoat=True)


@cache
def scatter_kernel(features):
    scatter = make_scatter(features)

    @kernel
    def run_scatter(materials: wp.array(dtype=structs.Material), front: int, shading: wp.vec3, geometric: wp.vec3,
                    wo: wp.array(dtype=wp.vec3), xi: wp.array(dtype=wp.vec2), out: wp.array(dtype=Scatter)):
        i = wp.tid()
        s = Surface()
        s.front = front
        s.geometric = geometric
        s.shading = shading
        s.smooth = geometric
        out[i] = scatter(materials[0], s, wo[i], cap_point(xi[i]))

    return run_scatter


def scatter(material, wo, xi=None, front=True, shading=(0.0, 0.0, 1.0), geometric=(0.0, 0.0, 1.0), features=EVERYTHING):
    wo = np.asarray(wo, np.float64).reshape(-1, 3)
    xi = np.full((len(wo), 2), 0.5) if xi is None else xi
    records = upload(material_records((material,), TextureTable()), structs.Material, DEVICE)
    out = zeros(len(wo), Scatter)
    launch(scatter_kernel(features), len(wo), records, int(front), wp.vec3(*shading), wp.vec3(*geometric), vec3s(wo),
           vec2s(xi), out)
    return out.numpy()


def slanted(degrees):
    angle = np.radians(np.atleast_1d(degrees))
    return np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)


def test_mirror_reflects_its_albedo_at_the_mirrored_angle():
    wo = unit(np.random.default_rng(1).normal(size=(500, 3)) * [1, 1, 0] + [0, 0, 0.5])
    out = scatter(Material("mirror", albedo=(0.9, 0.8, 0.7)), wo)
    assert np.allclose(out["reflected"], [0.9, 0.8, 0.7])
    assert np.allclose(out["reflection"], wo * [-1, -1, 1], atol=1e-6)
    assert not out["transmitted"].any() and not out["diffuse"].any()


def test_conductor_reflects_by_channel():
    eta, k = CONDUCTORS["gold"]
    out = scatter(Material("conductor", eta=eta, k=k), slanted([0.0, 30.0, 80.0]))
    for i, degrees in enumerate([0.0, 30.0, 80.0]):
        expected = [fresnel(np.cos(np.radians(degrees)), complex(a, b)) for a, b in zip(eta, k, strict=True)]
        assert np.allclose(out["reflected"][i], expected, atol=1e-5)


@pytest.mark.parametrize("front", [True, False])
def test_glass_obeys_snell_and_keeps_energy(front):
    degrees = np.concatenate([np.linspace(0.0, 89.0, 90), [41.8, 41.82]])
    wo = slanted(degrees)
    out = scatter(Material("glass", albedo=(1.0, 0.5, 1.0), ior=1.5), wo, front=front)
    eta = 1.5 if front else 1.0 / 1.5
    share = out["reflected"][:, 0].astype(np.float64)
    goes_on = np.sin(np.radians(degrees)) < eta * (1.0 - 1e-6)
    assert np.abs(share - np.where(goes_on, fresnel(np.cos(np.radians(degrees)), eta), 1.0)).max() < 3e-4
    assert np.allclose(out["reflection"], wo * [-1, -1, 1], atol=1e-6)
    refraction = out["refraction"][goes_on].astype(np.float64)
    assert np.abs(refraction[:, 0] + wo[goes_on, 0] / eta).max() < 1e-6  # sin_t = sin_i / eta, on the other side of the normal.
    assert (refraction[:, 2] < 0.0).all() and np.abs(refraction[:, 1]).max() < 1e-7
    assert np.abs(np.linalg.norm(refraction, axis=1) - 1.0).max() < 1e-6
    assert not out["transmitted"][~goes_on].any() and (share[~goes_on] == 1.0).all()
    # The flux is conserved: behind the boundary it is eta^2 times the radiance (PBR, section 9.5.2).
    assert np.allclose(share + out["transmitted"][:, 0] * eta**2, 1.0, atol=1e-5)
    assert np.allclose(out["transmitted"][:, 1], 0.5 * out["transmitted"][:, 0])
    assert (out["bends"] == goes_on).all()


def test_thin_glass_sums_the_reflections_of_both_faces():
    degrees = np.linspace(0.0, 85.0, 30)
    out = scatter(Material("glass", albedo=(1.0, 1.0, 0.25), ior=1.5, thin=True), slanted(degrees))
    r = fresnel(np.cos(np.radians(degrees)), 1.5)
    series = r + sum((1.0 - r) ** 2 * r ** (2 * k + 1) for k in range(60))
    assert np.abs(out["reflected"][:, 0] - series).max() < 1e-5
    assert np.allclose(out["transmitted"][:, 0], 1.0 - series, atol=1e-5)
    assert np.allclose(out["transmitted"][:, 2], 0.25 * (1.0 - series), atol=1e-5)
    assert np.allclose(out["refraction"], -slanted(degrees), atol=1e-6) and not out["bends"].any()
    assert out["reflected"][0, 0] == pytest.approx(1.0 / 13.0, abs=1e-6)


@pytest.mark.parametrize("ior", [1.33, 1.5, 5.0])
def test_specular_scales_the_reflectance_of_the_index(ior):
    degrees = np.linspace(0.0, 89.0, 60)
    wo, expected = slanted(degrees), fresnel(np.cos(np.radians(degrees)), ior)
    black = {"albedo": (0.0, 0.0, 0.0), "ior": ior}
    halved = scatter(Material("metallic_roughness", specular_factor=0.5, **black), wo, features=COATED)["reflected"]
    assert np.abs(halved - 0.5 * expected[:, None]).max() < 1e-5
    color = np.array([0.25, 0.0, 1e3])
    normal = np.minimum(1.0, ((ior - 1.0) / (ior + 1.0)) ** 2 * color)
    tinted = scatter(Material("metallic_roughness", specular_color=tuple(color), **black), wo, features=COATED)["reflected"]
    assert np.abs(tinted[0] - normal).max() < 1e-6
    assert (tinted >= 0.0).all() and (tinted <= 1.0).all()
    # With Schlick's approximation, this is the formula of KHR_materials_specular.
    schlick = scatter(Material("metallic_roughness", specular_color=tuple(color), **black), wo, features=replace(COATED, schlick=True))
    rise = (1.0 - np.cos(np.radians(degrees)))[:, None] ** 5
    assert np.abs(schlick["reflected"] - (normal + (1.0 - normal) * rise)).max() < 1e-5


def test_what_the_strongest_channel_does_not_reflect_stays_below():
    out = scatter(Material("metallic_roughness", albedo=(1.0, 1.0, 1.0), ior=2.0, specular_color=(3.0, 1.0, 0.0)), slanted(0.0),
                  features=COATED)
    assert np.allclose(out["reflected"], [3.0 / 9.0, 1.0 / 9.0, 0.0]) and np.allclose(out["diffuse"], 6.0 / 9.0)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_clear_coat_takes_its_fresnel_share_from_what_is_below(share):
    degrees = np.linspace(0.0, 89.0, 60)
    base = {"albedo": (0.8, 0.5, 0.2), "roughness": 0.6, "metallic": 0.3, "transmission": 0.4, "thin": True}
    bare = scatter(Material("metallic_roughness", **base), slanted(degrees), features=COATED)
    out = scatter(Material("metallic_roughness", clearcoat=share, **base), slanted(degrees), features=COATED)
    coat = share * fresnel(np.cos(np.radians(degrees)), 1.5)
    assert np.abs(out["coated"] - coat).max() < 1e-5 and coat[0] == pytest.approx(0.04 * share)
    assert np.allclose(out["coat_reflection"], slanted(degrees) * [-1, -1, 1], atol=1e-6) and not out["coat_exponent"].any()
    for name in ("reflected", "transmitted", "diffuse", "highlight"):
        assert bare[name].any() and np.allclose(out[name], (1.0 - coat)[:, None] * bare[name], atol=1e-6)
    assert np.allclose(out["below"], 1.0 - coat, atol=1e-6) and (bare["below"] == 1.0).all() and not bare["coated"].any()


def test_no_normal_map_bends_a_clear_coat():
    out = scatter(Material("metallic_roughness", clearcoat=1.0), slanted(30.0), shading=unit(np.array([0.4, 0.0, 1.0])), features=COATED)
    assert np.allclose(out["coat_reflection"], slanted(30.0) * [-1, -1, 1], atol=1e-6)
    assert not np.allclose(out["reflection"], out["coat_reflection"], atol=0.1)


def test_a_ray_inside_solid_glass_meets_no_coat():
    glass = Material("metallic_roughness", transmission=1.0, clearcoat=1.0)
    assert not scatter(glass, slanted(20.0), front=False, features=COATED)["coated"].any()
    assert scatter(replace(glass, thin=True), slanted(20.0), front=False, features=COATED)["coated"].all()


def some_materials():
    """Yield materials of each kind and extremes of metallic_roughness, all with albedo 1. Smooth ones must not absorb light."""
    rest = {"albedo": (1.0, 1.0, 1.0)}
    yield from (Material("mirror", **rest), Material("glass", ior=1.5, **rest), Material("glass", thin=True, **rest))
    yield Material("conductor", roughness=0.5)
    yield Material("glass", roughness=0.6, **rest)
    for metallic in (0.0, 0.4, 1.0):
        for transmission in (0.0, 0.5, 1.0):
            for roughness in (0.0, 0.7):
                yield Material("metallic_roughness", metallic=metallic, transmission=transmission, roughness=roughness, **rest)
    yield Material("diffuse", **rest)


def layered_materials():
    """Yield materials with clear coats and scaled reflectances, all with albedo 1."""
    for transmission in (0.0, 1.0):
        for roughness in (0.0, 0.7):
            yield Material("metallic_roughness", albedo=(1.0, 1.0, 1.0), transmission=transmission, roughness=roughness, clearcoat=0.9,
                           clearcoat_roughness=roughness, specular_factor=0.6, specular_color=(1.0, 5.0, 40.0))


@pytest.mark.parametrize("front", [True, False])
@pytest.mark.parametrize("material", [*some_materials(), *layered_materials()],
                         ids=lambda m: f"{m.kind}-{m.metallic}-{m.transmission}-{m.roughness}-{m.thin}-{m.clearcoat}")
def test_no_kind_creates_energy(material, front):
    rng = np.random.default_rng(2)
    xi = sobol_like(512, rng)
    for degrees in (0.0, 20.0, 45.0, 75.0, 88.0):
        features = COATED if material.is_coated else EVERYTHING
        out = scatter(material, np.repeat(slanted(degrees), 512, axis=0), xi, front=front, features=features)
        eta = np.where(out["bends"] != 0, material.ior if front else 1.0 / material.ior, 1.0)
        total = out["reflected"] + out["transmitted"] * (eta**2)[:, None] + out["diffuse"] + out["coated"][:, None]
        assert np.isfinite(total).all() and (total >= 0.0).all()
        assert (total <= 1.0 + 1e-5).all()
        sides = (("reflection", "reflected", 1.0), ("refraction", "transmitted", -1.0), ("coat_reflection", "coated", 1.0))
        for name, weight, side in sides:
            used = out[weight].reshape(len(out), -1).max(axis=1) > 0.0
            direction = out[name][used].astype(np.float64)
            assert np.abs(np.linalg.norm(direction, axis=1) - 1.0).max(initial=0.0) < 1e-5
            assert (direction[:, 2] * side > 0.0).all()
        if material.roughness == 0.0 and material.kind != "conductor" and not material.is_coated:
            assert (total > 1.0 - 1e-4).all()  # A smooth white surface absorbs nothing.


@pytest.mark.parametrize("kind", ["conductor", "glass", "metallic_roughness"])
def test_roughness_zero_and_tiny_are_the_same_mirror(kind):
    wo = slanted([10.0, 50.0])
    smooth = scatter(Material(kind, roughness=0.0, metallic=1.0), wo)
    nearly = scatter(Material(kind, roughness=0.012, metallic=1.0), wo, xi=np.full((2, 2), 0.3))
    assert np.allclose(smooth["reflected"], nearly["reflected"], atol=1e-2)
    assert np.allclose(smooth["reflection"], nearly["reflection"], atol=1e-2)


def test_rough_reflection_spreads_around_the_mirrored_direction():
    wo = np.repeat(slanted(30.0), 4096, axis=0)
    xi = sobol_like(4096, np.random.default_rng(3))
    spread = []
    for roughness in (0.1, 0.3, 0.6):
        out = scatter(Material("conductor", roughness=roughness), wo, xi)
        used = out["reflected"].max(axis=1) > 0.0
        assert used.mean() > 0.8
        spread.append(np.degrees(np.arccos(np.clip(out["reflection"][used] @ (wo[0] * [-1, -1, 1]), -1, 1))).mean())
    assert 0.3 < spread[0] < 5.0 and spread[0] < spread[1] < spread[2]


def test_the_highlight_of_a_rough_metal_has_the_width_of_its_facets():
    out = scatter(Material("metallic_roughness", metallic=1.0, roughness=0.5, albedo=(0.9, 0.6, 0.3)), slanted(0.0))
    assert out["exponent"][0] == pytest.approx(2.0 / 0.0625 - 2.0, rel=1e-5)
    assert (out["highlight"] >= out["reflected"] - 1e-6).all() and out["highlight"].any()


def test_interpolated_normals_never_send_a_ray_to_the_wrong_side():
    rng = np.random.default_rng(4)
    shading = unit(np.array([0.7, 0.0, 0.45]))
    wo = unit(rng.normal(size=(3000, 3)))
    wo = wo[(wo[:, 2] > 1e-3) & (wo @ shading > 1e-3)]
    for material in (Material("mirror"), Material("glass"), Material("conductor", roughness=0.5),
                     Material("glass", roughness=0.5), Material("metallic_roughness", transmission=0.5, roughness=0.4)):
        out = scatter(material, wo, rng.random((len(wo), 2)), shading=shading)
        assert (out["reflection"][:, 2] >= -1e-6).all()
        used = out["transmitted"].max(axis=1) > 0.0
        assert (out["refraction"][used, 2] < 0.0).all()


def test_both_tables_have_the_same_kinds():
    assert list(materials.MATERIALS) == list(MATERIALS)


@wp.func
def half(m: structs.Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    result = out
    result.reflected = 0.5 * m.albedo
    return result


def test_a_kind_from_outside_is_a_row_in_both_tables(monkeypatch):
    with refused("kind", "must be one", place="material"):
        Material("half")
    monkeypatch.setitem(MATERIALS, "half", MaterialKind("half a mirror"))
    half_mirror, whole = Material("half", albedo=(0.8,) * 3, roughness=0.7), Material("mirror", albedo=(0.8,) * 3)
    with refused(what="'half'"):
        scatter(half_mirror, slanted(30.0))
    monkeypatch.setitem(materials.MATERIALS, "half", lambda features: half)
    features = Features(materials=("mirror", "half"), reflection=True)
    for material, expected in ((half_mirror, 0.4), (whole, 0.8)):
        out = scatter(material, slanted(30.0), features=features)
        assert np.allclose(out["reflected"], expected) and np.allclose(out["reflection"], slanted(-30.0), atol=1e-6)
