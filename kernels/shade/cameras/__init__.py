"""Camera kinds, a module each: a struct `Camera`, and `make_camera_ray(features=None)`.

Camera is a Warp struct that begins with origin, right, up and forward, in world space. The last three are orthonormal. The host's
class of that kind fills its other fields in `record`.

make_camera_ray returns a Warp function (camera, film, xi) -> Ray, in world space and of unit direction:
- Film (0, 0) is the picture's top left corner, (1, 1) the bottom right one. A pixel filter reaches a little beyond.
- The lens sample xi, in [0, 1)^2, is drawn if features.lens is on.
- Without features, the ray goes through the middle of the lens.
- Where the film gets no light, the function returns wrt.kernels.shade.pixel_rays.no_ray()."""
