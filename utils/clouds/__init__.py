"""Point clouds: container, files, filters, pictures."""

from utils.clouds.cloud import PointCloud
from utils.clouds.io import read_cloud, write_cloud

__all__ = ["PointCloud", "read_cloud", "write_cloud"]
