"""Sources of training clips: the common interface and the TartanAir reader."""
