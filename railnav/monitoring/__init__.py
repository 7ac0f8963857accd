"""Track geometry: what shape is the track in, where does it leave its design, and what should the tamping machine do?"""
