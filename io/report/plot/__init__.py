"""`telerig.plot`: pictures of results for notebooks and papers, and all pictures of the reports.

In: tables as `telerig` returns and writes them, and optionally the axes to draw on. Out: matplotlib
axes. Each module names its functions in ``__all__``. Read ``bubbles`` first.
"""

from telerig.io.report.plot import bubbles as _bubbles
from telerig.io.report.plot import rig as _rig
from telerig.io.report.plot import shake as _shake
from telerig.io.report.plot import target as _target
from telerig.io.report.plot import tracking as _tracking
from telerig.io.report.plot.bubbles import *  # noqa: F403
from telerig.io.report.plot.rig import *  # noqa: F403
from telerig.io.report.plot.shake import *  # noqa: F403
from telerig.io.report.plot.target import *  # noqa: F403
from telerig.io.report.plot.tracking import *  # noqa: F403

__all__ = [
    name for module in (_bubbles, _rig, _shake, _target, _tracking) for name in module.__all__
]


def __dir__() -> list[str]:
    return sorted(__all__)
