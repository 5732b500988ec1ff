"""Event files, datasets, voxel grids, drivers and clouds: everything around the odometry."""
