"""Cameras and LiDARs as arrays of rays, and images of their hits.

>>> sensor = wrt.sensors.pinhole(K, (640, 480), camera_to_world)
>>> hits = accel.closest_hit(sensor.origins, sensor.directions)
>>> depth, faces = sensor.depth(hits), sensor.picture(hits.prim_id)
"""

from wrt.sensors.cameras import fisheye, pinhole, project, unproject
from wrt.sensors.images import Images
from wrt.sensors.lidars import LIDARS, LidarModel, lidar, raster_lidar, rotating_lidar, with_range_noise
from wrt.sensors.sensor import Sensor

__all__ = ["LIDARS", "Images", "LidarModel", "Sensor", "fisheye", "lidar", "pinhole", "project", "raster_lidar", "rotating_lidar",
           "unproject", "with_range_noise"]
