"""Camera kinds. Each kind is a module with a struct `Camera` and a function `make_camera_ray(features=None)`.

Camera is a Warp struct that begins with origin, right, up and forward, in world space; right, up and forward are orthonormal. The
host's class of the same kind (wrt/scene/cameras.py) sets the other fields in its method `record`.

make_camera_ray returns a Warp function (camera, film, xi) -> Ray. The ray is in world space and has a unit direction:
- Film point (0, 0) is the picture's top left corner, (1, 1) the bottom right corner. Pixel filters reach a little beyond [0, 1]^2.
- The lens sample xi lies in [0, 1)^2. It is 0 unless features.lens is set.
- With features = None, the ray goes through the middle of the lens.
- At film points that get no light, the function returns wrt.kernels.shade.pixel_rays.no_ray()."""
