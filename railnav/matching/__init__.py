"""Matching: which track? Candidates near a fix, paths over permitted movements, hypotheses and their evidence."""

from railnav.matching.candidates import Start, starting_candidates
from railnav.matching.network import pack_network

__all__ = ["Start", "pack_network", "starting_candidates"]
