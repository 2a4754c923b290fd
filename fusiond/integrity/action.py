"""What a filter shall do once an aid has been judged (fusiond.integrity.isolation)."""

from __future__ import annotations

from enum import Enum


class Action(Enum):
    """What the filter shall do after a judgement."""

    NONE = "none"
    DOUBT_MEASURED = "doubt measured"
    """What the series has said was taken over in part: widen by its innovation."""
    DOUBT_MOTION = "doubt motion"
    """The series is left out, but attitude and sensor errors may be what is wrong: widen them."""
    DOUBT_FILTER = "doubt filter"
    """Both."""


NONE = Action.NONE
"""By a name of its own: asked of its class a member costs 0.3 us in Python 3.11."""
MOTION = frozenset({Action.DOUBT_MOTION, Action.DOUBT_FILTER})
MEASURED = frozenset({Action.DOUBT_MEASURED, Action.DOUBT_FILTER})
