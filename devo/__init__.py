"""Deep event visual odometry: event voxel grids in, camera trajectory and sparse 3-D structure out.

Importing this package compiles nothing and needs neither GPU nor display. The tracker lives in
`devo.devo`, the networks in `devo.enet` and `devo.net`, checkpoints in `devo.checkpoint`.
"""

__version__ = "0.1.0"
