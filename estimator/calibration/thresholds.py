"""The thresholds by which a calibration is judged while it is made, each with its reason.

What becomes a finding has its limit in `telerig.io.results.findings`. Settings of an algorithm
(step sizes, grids, what a display shows) stand where they are used.
"""

from __future__ import annotations

from telerig.estimator.dots.thresholds import OUTLIER_SD as OUTLIER_SD
from telerig.io.results.findings import Code

LEAST_OUTLIER_SD = 3.0
"""The smallest limit that is accepted. It leaves out one correct dot in 90; with a lower limit too
much ordinary noise would be taken for outliers."""
SURE_SD = 5.0
"""A quantity differs from another one surely if it does by so many standard deviations, which
chance does once in two million cases: a perspective from none, chi-square from 1, exchanged scales.
"""
IMPOSSIBLE_SD = 20.0
"""Standard deviations by which a stated distance of two dots may differ from the nominal one: more
is a mistake in rig.toml, whatever the print's true distribution."""
UNLIKELY = 1e-3
"""A difference of two calibrations counts as real if chance alone causes one as large with less
than this probability."""
COPY_CHANCE = 1e-9
"""Two images of independent noise agree as well as copies do at most with this probability."""
CONSIDERED_P_VALUE = 0.01
"""The uncertainty of a group of parameters that are held is considered in the covariance if freeing
the group improves the fit with a p-value below this."""
GROUP_PENALTY = 4.0
"""Penalty of a group of parameters, divided by the logarithm of the number of groups. 2 would be
gamma = 1 of Chen and Chen; with 4 a group without effect is admitted by chance about once in 20 000
(docs/decisions/014)."""
UNDETERMINED = 0.5
"""A parameter counts as undetermined if its posterior standard deviation is more than this share of
the prior one."""
UNEXPLAINED = 0.3
"""If the ratio of noise floor to image noise exceeds this, errors of the lens model can change the
angle between the axes as much as uncertain image centres do."""
STRONG_PERSPECTIVE = 0.01
"""A lens with a larger kappa * rho counts as a perspective lens, whose images show the depth of a
view: the rays of a telecentric lens do not deviate from its axis by 0.6 degrees."""
LEAST_DOTS = int(Code.UNUSED_VIEWS.limit)
"""Number of different dots that a view or an image needs: fewer do not determine the pose of the
target."""
LEAST_VIEWS = 4
"""Number of views that determine a target of unknown dots (four equations, docs/theory.md), and the
least number in each half of the views of which two rigs are compared."""
RECOMMENDED_VIEWS = int(Code.FEW_VIEWS.limit)
LINE_SHARE = 0.01
"""Dots whose width across is less than this share of their length count as one row; two rows of 40
dots have 0.09."""
PARALLEL_DEG = 3.0
"""Views whose tilts differ by less count as parallel and are refused: a larger depth with a smaller
tilt gives nearly the same images."""
CLEAR_MISFIT = 0.1
"""Largest accepted distance of an image's dots from the map of the target's plane, as a share of
the dots' spread."""
TIE_DEG = 10.0
"""A nominal rotation does not decide between two rotations to which its distance differs by less:
it is measured by eye."""
TURN_TIE_DEG = 3.0
"""Images do not decide between two turns of a target without marks that explain the rotation
between two cameras to within so much: the rotations of single images are good to about a degree."""
FAR_BETTER = 0.02
"""If the images of one camera belong to other views, the mean square of the epipolar constraint
falls at least to this share with the right offset: to 1e-6 to 2e-4 in simulated views, where the
images that belong together are 250 times better than any others."""
FAR_BETTER_OF_TWO = 3e-4
"""The same where only two views show it: of 900 simulated datasets with 1-5 % of bad dots 14 have
two views that fit by chance to 0.02, one to 1e-3, none to 3e-4."""
UNPAIRED = 2.5e-5
"""Mean square of the epipolar constraint (half an image is 1) above which images may belong to
different views: distortion leaves up to 1e-6, wrong pairs 2e-4 in the best of ten windows (median).
The two sides of a thick plate leave up to 4e-4, with other pairs no less."""
ENOUGH_SHARE = 0.05
"""A view is worth taking if it lowers the standard deviation by at least this share."""
LEAST_TRAVEL_MM = 1.0
"""Shortest travel of a stage that is measured: with 10 px/mm a dot good to 0.02 px shows its
direction to 0.1 degrees."""
