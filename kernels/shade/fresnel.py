"""Fresnel's formulas: the reflectance of a smooth boundary."""

import warp as wp


@wp.func
def fresnel_dielectric(cos_i: float, eta: float) -> float:
    """Return the reflectance of a dielectric for unpolarised light; 1 at total internal reflection (Born and Wolf, section 1.5).

    cos_i >= 0 is the cosine of the angle of incidence. eta: the refractive index behind the boundary, divided by that in front."""
    sin2_t = (1.0 - cos_i * cos_i) / (eta * eta)
    if sin2_t >= 1.0:
        return 1.0
    cos_t = wp.sqrt(1.0 - sin2_t)
    parallel = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    perpendicular = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    return 0.5 * (parallel * parallel + perpendicular * perpendicular)


@wp.func
def fresnel_schlick(cos_i: float, eta: float) -> float:
    """Return Schlick's approximation (1994) of fresnel_dielectric. It uses the cosine in the medium of lower index."""
    c = cos_i
    if eta < 1.0:
        sin2_t = (1.0 - cos_i * cos_i) / (eta * eta)
        if sin2_t >= 1.0:
            return 1.0
        c = wp.sqrt(1.0 - sin2_t)
    r = (eta - 1.0) / (eta + 1.0)
    m = 1.0 - c
    return r * r + (1.0 - r * r) * m * m * m * m * m


@wp.func
def contrast(a: float, b: float) -> float:
    """Return (a - b) / (a + b), or 1 if both are 0, as in the limit of grazing incidence."""
    return wp.where(a + b > 0.0, (a - b) / (a + b), 1.0)


@wp.func
def fresnel_conductor(cos_i: float, eta: float, k: float) -> float:
    """Return the reflectance of a metal of index eta + i k for unpolarised light (Born and Wolf, section 14.2)."""
    c2 = cos_i * cos_i
    s2 = 1.0 - c2
    t0 = eta * eta - k * k - s2
    a2_b2 = wp.sqrt(t0 * t0 + 4.0 * eta * eta * k * k)
    a = wp.sqrt(wp.max(0.0, 0.5 * (a2_b2 + t0)))
    t1 = a2_b2 + c2
    t2 = 2.0 * a * cos_i
    perpendicular = contrast(t1, t2)
    t3 = c2 * a2_b2 + s2 * s2
    t4 = t2 * s2
    parallel = perpendicular * contrast(t3, t4)
    return 0.5 * (perpendicular + parallel)


@wp.func
def fresnel_tint(cos_i: float, f0: wp.vec3) -> wp.vec3:
    """Return Schlick's reflectance of glTF 2.0's metals, from the colour f0 at normal incidence to white at grazing incidence."""
    m = 1.0 - cos_i
    return f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * (m * m * m * m * m)
