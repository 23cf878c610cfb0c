"""Camera kinds, a module each: a struct `Camera`, and `make_camera_ray`.

Camera: a Warp struct that begins with origin, right, up and forward (world space; the last three are orthonormal); its other fields
are what the host's class of that kind puts into `record`.

make_camera_ray(features=None): a Warp function (camera, film, xi) -> Ray in world space, of unit direction. film: (0, 0) is the
picture's top left corner, (1, 1) the bottom right one, and a pixel filter reaches a little beyond. xi: a sample of the lens, in
[0, 1)^2; it is drawn where features.lens is on. features: what the kernel is compiled from; None: the ray through the middle of the
lens. Where the film gets no light, it returns wrt.kernels.shade.pixel_rays.no_ray().
"""
