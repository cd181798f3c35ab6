"""Converts a calibration to a `gtsam.NonlinearFactorGraph`, for users who continue with GTSAM.

The solvers of telerig evaluate all images at once instead; the cost and the minimum are the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.estimator.calibration.solver.problem import Problem, parameter_unit
from telerig.estimator.calibration.solver.system import System, images_of
from telerig.factors.calibration import State
from telerig.factors.custom_factors import (
    Keys,
    depth_gauge_factor,
    distance_factor,
    image_factor,
    place_factor,
)


def keys_of(problem: Problem) -> Keys:
    """Return GTSAM's keys of a problem's variables.

    They are k0, ... for intrinsics, c1, ... for poses of cameras, v0, ... for views and d0, ... for
    dots.
    """
    import gtsam

    cameras = range(len(problem.cameras))
    free = [problem.free_indices(c) for c in cameras]
    return Keys(
        intrinsics=tuple(gtsam.symbol("k", i) for i in cameras),
        camera=tuple(gtsam.symbol("c", i) for i in cameras),
        view=tuple(gtsam.symbol("v", i) for i in range(len(problem.views))),
        dots=tuple(gtsam.symbol("d", i) for i in range(len(problem.dot_ids))),
        free=tuple(free),
        unit=tuple(parameter_unit(c)[f] for c, f in zip(problem.cameras, free)),
    )


def nonlinear_graph(problem: Problem, start: State) -> tuple[Any, Any, Keys]:
    """Return a problem as gtsam.NonlinearFactorGraph, the start as gtsam.Values, and their keys."""
    import gtsam

    keys, system = keys_of(problem), System(problem)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for c, (camera, obs) in enumerate(zip(problem.cameras, system.images)):
        for _, first, last in images_of(obs):
            image = obs.subset(slice(first, last))
            graph.add(image_factor(keys, start, image, c, camera.rho_mm))
        free, unit = keys.free[c], keys.unit[c]
        if len(free):
            mean = (camera.intrinsics - start.intrinsics[c])[free] / unit
            noise = gtsam.noiseModel.Diagonal.Sigmas(problem.prior_sigma(c)[free] / unit)
            graph.add(gtsam.PriorFactorVector(keys.intrinsics[c], mean, noise))
            values.insert(keys.intrinsics[c], np.zeros(len(free)))
        if c:
            both = c == problem.origin_camera
            graph.add(depth_gauge_factor(keys.camera[c], problem.gauge_sigma_mm, both=both))
            values.insert(keys.camera[c], gtsam.Pose3(start.rig_from_camera[c]))
    for key, view in zip(keys.view, start.rig_from_target):
        graph.add(place_factor(key, system.place_sigma_mm))
        values.insert(key, gtsam.Pose3(view))
    for key, nominal, sd, place in zip(keys.dots, *problem.stretched_mm, start.dots_mm):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sd)
        graph.add(gtsam.PriorFactorVector(key, nominal, noise))
        values.insert(key, place)
    if problem.scale is not None:
        (a, b), distance, sd = problem.scale
        graph.add(distance_factor(keys.dots[a], keys.dots[b], distance, sd))
    return graph, values, keys
