"""Navigation: a train held to its track model: where on which track, how fast, how sure."""

from railnav.navigation.epochs import Epoch, epochs
from railnav.navigation.explanation import Candidate, Decision
from railnav.navigation.navigator import Alternative, Navigator, Position
from railnav.navigation.offline import navigate
from railnav.navigation.solution import Alternatives, Mode, Solution
from railnav.navigation.state import Settings, State, layout

__all__ = [
    "Alternative",
    "Alternatives",
    "Candidate",
    "Decision",
    "Epoch",
    "Mode",
    "Navigator",
    "Position",
    "Settings",
    "Solution",
    "State",
    "epochs",
    "layout",
    "navigate",
]
