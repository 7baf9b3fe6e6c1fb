"""Finds poses and points from verified matches, by COLMAP's incremental or global mapper and bundle adjustment.

Sources: J. Schönberger, J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016; L. Pan et al., Global
Structure-from-Motion Revisited (GLOMAP), ECCV 2024; both as in pycolmap.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pycolmap

_GROWTH = 1.4  # growth of a model between two global adjustments
_REFINEMENTS = 2, 1  # global and local; ``adjust_model`` refines everything at the end
_TOLERANCES = 1e-5, 1e-4
_LEAST_IMAGES = 3
_MOST_MODELS = 8
_ITERATIONS = 40
_CLEARLY_BETTER = 0.98  # ratio of the squared errors with and without distortion; about 0.9998 if there is none

_DISTORTED = "SIMPLE_RADIAL"


def map_incrementally(
    database: Path, folder: Path, fixed: bool, registered: Callable[[], None], start: Path | None = None
) -> list[pycolmap.Reconstruction]:
    """Models, the largest first. fixed: keep the intrinsics.  registered: called for each image that gets a pose.

    start: a saved model to continue.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.random_seed = 0
    options.min_model_size = _LEAST_IMAGES
    options.max_num_models = _MOST_MODELS
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_max_refinements, options.ba_local_max_refinements = _REFINEMENTS
    options.ba_global_function_tolerance, options.ba_local_function_tolerance = _TOLERANCES
    if fixed:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    found = pycolmap.incremental_mapping(
        database, folder, _fresh(folder / "models"), options, start or "", registered, registered
    )
    return _largest_first(found)


def map_globally(database: Path, folder: Path, fixed: bool) -> list[pycolmap.Reconstruction]:
    """Models, the largest first. Places all images at once, which is faster but needs more matches."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    if fixed:
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
    return _largest_first(pycolmap.global_mapping(database, folder, _fresh(folder / "models"), options))


def continue_mapping(
    database: Path, folder: Path, fixed: bool, model: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """The model with those missing images that can be placed now that the model is complete."""
    begun = _fresh(folder / "begun")
    model.write(begun)
    more = map_incrementally(database, folder, fixed, lambda: None, begun)
    return more[0] if more and more[0].num_reg_images() > model.num_reg_images() else model


def silence_colmap() -> None:
    """Make COLMAP print nothing: errors and warnings say what went wrong."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value


def _fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _largest_first(found: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


def adjust_model(model: pycolmap.Reconstruction, fixed: bool, distorts: bool) -> pycolmap.Reconstruction:
    """The model after bundle adjustment with a robust loss. ``distorts``: the camera model has distortion. Otherwise
    distortion is added if that clearly lowers the error. Changes the model in place, but may return another one."""
    if fixed or distorts:
        _adjust(model, fixed)
        return model
    bent = pycolmap.Reconstruction(model)
    for camera in bent.cameras.values():
        _distort(camera)
    straight_error, bent_error = _adjust(model, fixed), _adjust(bent, fixed)
    return bent if bent_error < _CLEARLY_BETTER * straight_error else model


def _adjust(model: pycolmap.Reconstruction, fixed: bool) -> float:
    """Run bundle adjustment. Returns the sum of robust squared errors."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = not fixed
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    solved = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return float(solved.ceres_summary.final_cost)


def _distort(camera: pycolmap.Camera) -> None:
    """Add distortion parameters, initially 0, to a pinhole camera."""
    bent = pycolmap.Camera.create_from_model_name(
        camera.camera_id, _DISTORTED, camera.mean_focal_length(), camera.width, camera.height
    )
    bent.principal_point_x, bent.principal_point_y = camera.principal_point_x, camera.principal_point_y
    camera.model, camera.params = bent.model, bent.params
