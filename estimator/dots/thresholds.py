"""The thresholds by which dots are found, fitted, numbered and followed, each with its reason.

Settings of an algorithm (step sizes, sizes of windows, numbers of trials) stand where they are
used.
"""

from __future__ import annotations

OUTLIER_SD = 4.5
"""What is farther than this many standard deviations from its prediction is no part of it, with
Gaussian noise 7e-6 of all correct values: a pixel of a dot, a view of two cameras, a mark. Of the
dots of a calibration, which have two coordinates, it leaves out 4e-5."""
RARE = 1e-4
"""A candidate is no dot, and a fit is worse than the noise, if less than this share of true dots
are as far from what is expected."""
LOG_SPREAD = 0.25
"""Least standard deviation of log radius and log contrast of the dots of one image: marks are up to
twice as large as dots, and light falls off towards the corners."""
LOG_FITTED = 0.15
"""Standard deviation of the log of a dot's fitted size divided by that of its blob, and of the way
between both centres divided by the radius."""
SIZE_SPREAD, OTHER_SIZE_SD = 0.01, 5.0
"""Standard deviation of the log radii of a plate's dots about their trend, 0.003 to 0.008 on real
plates; and by how many standard deviations a dot of another size differs."""
SIZES_SPREAD_SD = 3.0
"""Where the scatter of the sizes is more than this many times that of a plate, a disc is not what
most dots look like."""
BLOB_BLUR = 1.2
"""Semi-axis of a blurred line at half of its light, in standard deviations of the blur."""
LOG_MISFIT = 0.15
"""Standard deviation of the log of a true dot's misfit about the median of its image, 0.1 to 0.2 on
real plates."""
LEAST_MISFIT = 0.02
"""A misfit that any dot may have: rounding, specks of dust, an edge without blur."""
MODEL_RESIDUAL = 0.03
"""What the luminance model leaves of true dots (`DotFit.misfit`) where few dots show it; medians of
seven images of real plates are 0.026 to 0.058."""
OUTLINE_PX, OUTLINE_SD = 0.3, (0.02, 0.004)
"""RMS distance of a dot's outline from the ellipse of its blob, as pixels are drawn; and standard
deviation of its excess, in px and per semi-minor axis."""
ROUGH_SPREAD = 0.3
"""Standard deviation of the excess where most outlines are uneven, as a share of its median: the
RMS of the six harmonics or so of a rough edge that an outline shows."""
HOLE_SHARE = 0.02
"""Least share of a ring's area that is hole; specks of dust are smaller."""
FALSE = 0.0025
"""Probability that a plain dot is seen as a mark (one in four plates of a hundred dots has one), or
that something is seen as a dot at a place of the grid where the target has none."""
MARK_MISSED = 0.02
"""Probability that a mark is seen as a plain dot: its ring is blurred, or dirt fills it."""
DOT_LOST = 0.1
"""Probability that a dot in view is not found: dirt, glare, a scratch."""
PART_HIDDEN = 0.001
"""Probability that something hides a part of the target that is in view: a shadow, a vignette. It
bounds what dots that are missing side by side can prove."""
WRONG_ODDS = 0.005
"""A numbering is unique if each other one has less than this probability, relative to it."""
POSSIBLE_ODDS = 1e-6
"""Numberings with less than this probability, relative to the best one, are not listed."""
MOST_DOTS = 0.8
"""Least share of the dots that are on one grid, and of a whole grid's places that have a dot: 1.00
on real plates, 0.5 with rows that are staggered by half a pitch or lie on two levels. A match of
listed points is unique if the next one explains fewer than this share of its dots."""
SAME_CELL = 0.08
"""Departures of a lattice's cosine, and of its pitches' ratio, that measuring explains."""
LEAST_FRAMES = 3
"""Frames in which a dot of a strip is seen at least, at one place of the tank: fewer may be a
bubble or dirt."""
TOUCHED = 0.25
"""A dot of a strip is touched by a bubble if the screen round it differs from the background by
more than this share of the dot's contrast."""
