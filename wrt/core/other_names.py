"""Names that users of other libraries type, and what wrt calls the same thing. `did_you_mean` suggests it where it is known."""

OTHER_NAMES = {
    # Of hits.
    "t_hit": "t", "depth": "distance", "locations": "points", "face_normals": "normals", "primitive_normals": "normals", "p": "point",
    "n": "normal", "primitive_ids": "prim_id", "face_id": "prim_id", "index_tri": "prim_id", "face": "prim_id", "faces": "prim_id",
    "triangle": "prim_id", "triangle_id": "prim_id", "geometry_ids": "object", "geom_id": "object", "geomID": "object",
    "instID": "instance", "barycentric": "u", "primitive_uvs": "u", "valid": "hit", "is_valid": "hit", "mask": "hit",
    # Of structures and functions.
    "cast_rays": "closest_hit", "intersect": "closest_hit", "intersects_first": "closest_hit", "intersects_location": "closest_hit",
    "raycast": "closest_hit", "ray_cast": "closest_hit", "ray_intersect": "closest_hit", "query": "closest_hit",
    "query_ray": "closest_hit", "ray_test": "any_hit", "intersects_any": "any_hit", "occluded": "any_hit", "test_occlusions": "any_hit",
    "update": "refit", "set_transform": "move", "compute_signed_distance": "signed_distance", "compute_occupancy": "contains",
    "compute_distance": "closest_points", "compute_closest_points": "closest_points", "closest_point": "closest_points",
    "count_intersections": "count_hits", "list_intersections": "all_hits", "intersects_id": "all_hits",
    # Of pictures.
    "write": "save", "write_bitmap": "save", "export": "save", "rgb": "pixels", "image": "pixels",
    # Of arguments.
    "tfar": "t_max", "max_distance": "t_max", "max_dist": "t_max", "tnear": "t_min", "worlds": "world", "env_ids": "world",
    "width": "size", "height": "size", "resolution": "size", "samples": "spp", "samples_per_pixel": "spp",
    # Of scenes.
    "matrix": "transform", "to_world": "transform", "fov": "fov_y", "yfov": "fov_y", "color": "albedo", "base_color": "albedo",
    "reflectance": "albedo", "dielectric": "glass", "metal": "conductor", "lambertian": "diffuse", "principled": "metallic_roughness",
}
