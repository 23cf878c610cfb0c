"""Names that users of other libraries type, and what wrt calls the same thing. `did_you_mean` suggests it where it is known."""

from collections.abc import Collection

# If wrt has several names, a space separates them.
OTHER_NAMES = {
    # Of hits.
    "t_hit": "t", "depth": "distance", "locations": "points", "face_normals": "normals", "primitive_normals": "normals", "p": "point",
    "n": "normal", "primitive_ids": "face", "face_id": "face", "index_tri": "prim_id", "primID": "face", "faces": "prim_id",
    "triangle": "prim_id", "triangle_id": "prim_id", "geometry_ids": "object", "geom_id": "object", "geomID": "object",
    "instID": "instance", "barycentric": "u", "primitive_uvs": "u", "valid": "hit", "is_valid": "hit", "mask": "hit",
    # Of structures and functions.
    "cast_rays": "closest_hit", "intersect": "closest_hit", "intersects_first": "closest_hit", "mesh_query_ray": "ray_query",
    "raycast": "closest_hit", "ray_cast": "closest_hit", "ray_intersect": "closest_hit", "query": "closest_hit",
    "query_ray": "closest_hit", "ray_test": "any_hit", "intersects_any": "any_hit", "occluded": "any_hit", "test_occlusions": "any_hit",
    "update": "refit", "set_transform": "move", "compute_signed_distance": "signed_distance", "compute_occupancy": "contains",
    "compute_distance": "closest_points", "compute_closest_points": "closest_points", "closest_point": "closest_points",
    "count_intersections": "count_hits", "list_intersections": "all_hits", "intersects_id": "all_hits",
    "intersects_location": "all_hits", "num_triangles": "geometry", "n_triangles": "geometry", "cpu": "numpy",
    # Of pictures.
    "write": "save", "write_bitmap": "save", "export": "save", "show": "save", "rgb": "pixels", "image": "pixels",
    # Of arguments.
    "tfar": "t_max", "max_distance": "t_max", "max_dist": "t_max", "tnear": "t_min", "worlds": "world", "env_ids": "world",
    "width": "size", "height": "size", "resolution": "size", "samples": "spp", "samples_per_pixel": "spp",
    "fx": "intrinsics", "fy": "intrinsics", "K": "intrinsics", "eye": "position", "look_from": "position", "center": "target",
    "look_at": "target", "lookat": "target",
    # Of scenes.
    "matrix": "transform", "to_world": "transform", "fov": "fov_y intrinsics", "yfov": "fov_y intrinsics",
    "fov_y": "intrinsics", "color": "albedo intensity irradiance",
    "indices": "faces", "points": "vertices", "load_file": "load_scene", "lambert": "diffuse", "base_color": "albedo",
    "reflectance": "albedo", "dielectric": "glass", "metal": "conductor", "lambertian": "diffuse", "principled": "metallic_roughness",
}


def same_name(name: str, known: Collection[str]) -> str:
    """Return the first known name that means the same as `name`; "" if none does."""
    return next((ours for ours in OTHER_NAMES.get(name, "").split() if ours in known), "")
