"""A field that is added later leaves results from before it fresh."""

from dataclasses import dataclass

from recon_cli.config.fields import StageConfig, option
from recon_cli.config.stages import IngestConfig, RunConfig


@dataclass(frozen=True)
class Config(StageConfig):
    """A stage whose second field is newer than its results."""

    old: int = option(1, "Old.")
    new: str = option("auto", "New.", choices=("auto", "other"), late=True)


def test_a_late_field_is_hashed_only_where_it_is_not_its_default():
    assert Config().hashed_fields() == {"old": 1}
    assert Config(new="other").hashed_fields() == {"old": 1, "new": "other"}


def test_the_camera_of_ingest_is_such_a_field():
    assert "camera" not in IngestConfig().hashed_fields()
    assert IngestConfig(camera="equirectangular").hashed_fields()["camera"] == "equirectangular"


def test_a_field_of_another_name_takes_what_was_stored_under_the_old_one():
    stored = RunConfig(background="on", brightness="even").hashed_fields()
    old = {{"background": "far", "brightness": "look"}.get(name, name): value
           for name, value in stored.items()}
    assert RunConfig.rename(old) == stored == RunConfig.rename(stored)
    assert RunConfig.rename({"look": "walk", "other": 1}) == {"brightness": "filmed", "other": 1}


def test_a_model_without_optional_parts_is_told_by_their_declarations():
    plain = RunConfig.plain_values()
    assert set(plain.values()) == {"off"}
    assert {"background", "stereo", "exposure", "vignette", "depth"} == plain.keys()
    assert set(plain) - set(RunConfig.plain_values(late=False)) == {"vignette", "depth"}
