"""Track geometry: the shape a track is in, where it leaves its design, and what the tamping machine should do."""
