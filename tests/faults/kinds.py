"""The kinds of faults, one a row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import disk_kinds
import environment_kinds
import input_kinds
import kill_kinds
import pair_kinds
import settings_kinds
import structure_kinds
import workspace_kinds
from case import Case
from judge import Verdict


@dataclass(frozen=True)
class Kind:
    """One row of the table."""

    name: str
    share: int  # of a thousand faults
    inject: Callable[[Case], Verdict]


KINDS = (
    Kind("kill", 100, kill_kinds.kill),
    Kind("signal", 60, kill_kinds.interrupt),
    Kind("signal to a process", 16, kill_kinds.process_signal),
    Kind("full disk", 50, disk_kinds.full_disk),
    Kind("size limit", 28, disk_kinds.limited_files),
    Kind("finished file", 196, workspace_kinds.finished_file),
    Kind("unfinished file", 160, workspace_kinds.unfinished_file),
    Kind("structure", 70, structure_kinds.structure),
    Kind("manifest names", 40, structure_kinds.manifest_names),
    Kind("manifest values", 30, structure_kinds.manifest_values),
    Kind("two at once", 50, pair_kinds.pair),
    Kind("video", 40, input_kinds.hostile_video),
    Kind("data set", 50, input_kinds.hostile_set),
    Kind("splat file", 50, input_kinds.hostile_splats),
    Kind("settings", 25, settings_kinds.settings),
    Kind("camera path", 15, settings_kinds.camera_path),
    Kind("odd folder", 10, settings_kinds.places),
    Kind("bad folder", 5, settings_kinds.bad_places),
    Kind("odd option", 5, settings_kinds.odd_words),
    Kind("other version", 60, environment_kinds.other_version),
    Kind("environment", 40, environment_kinds.environment),
    Kind("permissions", 40, environment_kinds.permissions),
    Kind("clock", 16, environment_kinds.clock),
    Kind("renamed", 40, environment_kinds.renamed),
    Kind("kernel cache", 8, environment_kinds.kernel_cache),
    Kind("bad batch", 4, environment_kinds.bad_batch),
    Kind("recording", 20, input_kinds.hostile_recording),
)


def schedule(count: int) -> list[tuple[Kind, int]]:
    """Returns the kind of each fault and how many of the kind came before: all kinds, evenly.

    The first so many of a longer run are those of a shorter one.
    """
    total, given = sum(kind.share for kind in KINDS), dict.fromkeys(KINDS, 0)
    order = []
    for number in range(1, count + 1):
        kind = max(KINDS, key=lambda one: one.share * number / total - given[one])
        order.append((kind, given[kind]))
        given[kind] += 1
    return order
