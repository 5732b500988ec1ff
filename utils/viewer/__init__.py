"""Looking at a cloud and a trajectory: a page for any browser (`page`), or a window of Open3D (`window`)."""
