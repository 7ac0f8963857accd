"""Square-root estimation: chains, filters and smoothers, gross-error tests and consistency. Pure linear algebra.

This room knows nothing of the Earth, of track or of trains.
"""
