"""Sensor depth: rendered depth is compared with it in the loss, where the sensor is sure."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from recon_cli.config.stages import RunConfig
from recon_cli.errors import ConfigError
from recon_cli.io.sensor_depth import MOST_SAMPLES, SAMPLE_BYTES, SensorViews, read_sensor_depth
from recon_cli.scene.scene import Scene
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.parts.decisions import Rule
from recon_cli.train.parts.part import Part, Sign, TrialScene

# Loss that speaks against depth, which was measured: with exact depth a wall lost -.04 to .13 dB by
# the seed alone, and with depth that is wrong by a third -.06 to .19.
DEPTH_DB = 0.2
# Weight in the loss: at the start, where it places the surfaces, and the share that is left at the
# end, where the images place what is finer than noise. Twice as much gave no better surfaces in
# three rooms, and cost .2 dB in one.
_WEIGHT, _END = 0.005, 0.03
_EVERY = 2  # steps; densification looks at the others, which colours alone decide

logger = logging.getLogger("recon")


def load_sensor_depth(scene: Scene, config: RunConfig) -> SensorViews:
    """Returns the sensor depth of the training views, none if the options do without.

    Raises:
        ConfigError: the options ask for it, but there is none that fits.
    """
    if config.depth == "off" or (config.depth == "auto" and config.densify == "reference"):
        return SensorViews()  # 3DGS knows of no depth
    sensor = read_sensor_depth(scene)
    if sensor.left_out:
        logger.info("sensor depth contradicts the model in %d views, and is not used there: %s",
                    len(sensor.left_out), ", ".join(sensor.left_out))
    if config.depth == "on" and not sensor.depths and scene.cell is None:
        raise ConfigError(
            "depth is on, but " + (f"the sensor depth does not fit: {sensor.refused}."
                                   if sensor.refused else "no training view has sensor depth."),
            hint="Leave out --depth on.")
    return sensor


def depth_bytes(scene: Scene, config: RunConfig) -> int:
    """Returns the memory that the depth of the training views takes at most."""
    if scene.depth is None or config.depth == "off":
        return 0
    return len(scene.train) * MOST_SAMPLES * SAMPLE_BYTES


def weigh(schedule: Schedule, iteration: int) -> Mapping[str, float]:
    """Returns the weight of sensor depth in the loss of a step, 0 where it has no part.

    It is least from the start where another run has placed the surfaces.
    """
    if schedule.config.depth != "on" or iteration % _EVERY:
        return {"depth_weight": 0.0}
    done = 1.0 if schedule.first else schedule.share(iteration)
    return {"depth_weight": float(_WEIGHT * _END**done)}


def _find_sensor(scene: TrialScene) -> Sign:
    return Sign() if scene.task.has_depth else Sign(on=False, reason=scene.task.depth_refused)


# It puts surfaces where they are, which the views of the path need not show.
PART = Part("depth", _find_sensor, rule=lambda _: Rule(DEPTH_DB, unless_worse=True),
            step_options=weigh)
