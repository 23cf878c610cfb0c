"""Films made from device arrays, with their statistics."""

from dataclasses import replace
from typing import Any

import numpy as np

from wrt.core.version import VERSION
from wrt.picture.film import Film
from wrt.picture.tonemap import auto_exposure
from wrt.renderer.film_arrays import VISIBLE, DeviceFilm, needed_depth
from wrt.renderer.plan import Plan

Facts = dict[str, Any]  # entries of a film's stats


def film_of(plan: Plan, arrays: DeviceFilm, seed: int, aov: dict[str, np.ndarray], seconds: dict[str, float], facts: Facts) -> Film:
    """Return the film with its statistics. facts: entries of Film.stats about the scene, its structure and the end of the run."""
    arrays = arrays.snapshot()
    options, settings, samples = plan.options, plan.scene.settings, arrays.samples()
    total = max(int(samples.sum()), 1)
    rays = arrays.count("rays")
    ior = max((m.ior for m in plan.scene.materials if m.kind == "glass" or m.transmission > 0.0), default=1.0)
    most_by_throughput = settings.min_throughput * ior**2  # inside glass, radiance is larger by ior^2
    lost = arrays.lost_by_depth(most_by_throughput) if plan.features.reflection else np.zeros(samples.shape)
    stats: dict[str, Any] = {
        "seconds": seconds, "rays": rays, "rays_per_sample": rays / total,
        "rays_per_second": rays / seconds["trace"] if seconds["trace"] > 0.0 else 0.0,
        "cut_by_depth": arrays.count("cut_depth"), "cut_by_throughput": arrays.count("cut_throughput"),
        "lost_throughput_per_sample": arrays.lost_throughput() / total,
        "visibly_cut": float((lost > VISIBLE).mean()), "lost_by_depth": float(lost.mean()),
        "needed_depth": needed_depth(lost, settings.max_depth),
        "clamped_share": arrays.clamped_share() if settings.clamp else 0.0,
        "not_finite": arrays.count("not_finite"), "samples": int(samples.sum()), **facts,
    }
    if options.target_error is not None:
        error = arrays.error()
        stats |= {"estimated_error": error, "target_error": options.target_error,
                  "target_reached": error <= options.target_error and int(samples.min()) > 0}
    metadata = {
        "scene": plain_text(plan.scene.name), "camera": plain_text(plan.camera.name), "spp": int(samples.max()), "seed": seed,
        "seconds": round(seconds["trace"], 3), "version": VERSION, "max_depth": settings.max_depth, "filter": settings.filter,
        "accel": options.accel, "device": ",".join(options.devices or [options.device]),
    }
    if settings.clamp:
        metadata |= {"clamp": settings.clamp, "clamped_share": stats["clamped_share"]}
    return replace(bare_film(plan, arrays), aov=aov, stats=stats, metadata=metadata)


def bare_film(plan: Plan, arrays: DeviceFilm) -> Film:
    """Return a film with pixels, variance and samples only. arrays: result of DeviceFilm.snapshot."""
    settings = plan.scene.settings
    pixels, variance = arrays.pixels_and_variance()
    exposure = settings.exposure + (auto_exposure(pixels) if settings.auto_exposure else 0.0)
    return Film(pixels, variance, arrays.samples(), exposure=exposure, tonemap=settings.tonemap)


def plain_text(name: str) -> str:
    """Return a name that UTF-8 can encode: lone surrogates, which glTF files and file names may contain, become "?"."""
    return name.encode("utf-8", "replace").decode()
