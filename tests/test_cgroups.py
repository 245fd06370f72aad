"""Limits of control groups, in folders laid out as Linux lays them out."""

import pytest

from recon_cli import cgroups, machine

GB = 1 << 30


class Linux:
    """A /proc/self and the mounted trees of groups."""

    def __init__(self, folder):
        self.proc, self.folder = folder / "proc", folder
        self.proc.mkdir()

    def mount(self, kind, place, options="rw", root="/"):
        point = str(self.folder / place).replace(" ", "\\040")
        with (self.proc / "mountinfo").open("a") as file:
            file.write(f"30 23 0:26 {root} {point} rw,nosuid shared:4 - {kind} cgroup {options}\n")

    def join(self, *lines):
        (self.proc / "cgroup").write_text("\n".join(lines) + "\n")

    def write(self, place, **values):
        folder = self.folder / place
        folder.mkdir(parents=True, exist_ok=True)
        for name, value in values.items():
            (folder / name.replace("__", ".")).write_text(f"{value}\n")


@pytest.fixture
def linux(tmp_path):
    return Linux(tmp_path)


def test_where_there_are_no_groups_there_is_no_limit(linux):
    assert cgroups.free_memory_bytes(linux.proc) is None
    assert cgroups.most_cpus(linux.proc) is None


def test_the_tightest_of_the_own_group_and_those_above_counts(linux):
    linux.mount("cgroup2", "tree of groups")
    linux.join("0::/system.slice/room.service/worker")
    top = "tree of groups/system.slice"
    linux.write(top, memory__max=8 * GB, memory__current=5 * GB, cpu__max="150000 100000")
    linux.write(f"{top}/room.service", memory__max=4 * GB, memory__current=2 * GB,
                cpu__max="max 100000")
    linux.write(f"{top}/room.service/worker", memory__max="max", memory__current=GB,
                cpu__max="800000 100000")
    assert cgroups.free_memory_bytes(linux.proc) == 2 * GB
    assert cgroups.most_cpus(linux.proc) == 2
    linux.write(top, memory__current=7 * GB)
    assert cgroups.free_memory_bytes(linux.proc) == GB
    linux.write(top, memory__current=9 * GB)
    assert cgroups.free_memory_bytes(linux.proc) == 0


def test_files_that_are_cached_count_as_free(linux):
    linux.mount("cgroup2", "tree")
    linux.join("0::/job")
    linux.write("tree/job", memory__max=4 * GB, memory__current=4 * GB,
                memory__stat=f"anon {GB}\nfile {3 * GB}\ninactive_file {2 * GB}\nactive_file {GB}")
    assert cgroups.free_memory_bytes(linux.proc) == 3 * GB


def test_version_1_has_a_tree_for_each_controller(linux):
    linux.mount("cgroup", "memory", "rw,memory")
    linux.mount("cgroup", "cpu", "rw,cpu,cpuacct")
    linux.mount("cgroup2", "unified")
    linux.join("4:memory:/slurm/job_7/step_0", "2:cpu,cpuacct:/slurm/job_7", "0::/")
    linux.write("memory/slurm/job_7/step_0", memory__limit_in_bytes=(1 << 63) - 4096,
                memory__usage_in_bytes=GB)
    linux.write("memory/slurm/job_7", memory__limit_in_bytes=3 * GB, memory__usage_in_bytes=2 * GB,
                memory__stat=f"inactive_file 7\ntotal_inactive_file {GB // 2}")
    linux.write("cpu/slurm/job_7", cpu__cfs_quota_us=250000, cpu__cfs_period_us=100000)
    linux.write("cpu", cpu__cfs_quota_us=-1, cpu__cfs_period_us=100000)
    assert cgroups.free_memory_bytes(linux.proc) == GB + GB // 2
    assert cgroups.most_cpus(linux.proc) == 3


def test_a_container_may_see_only_its_own_part_of_the_tree(linux):
    linux.mount("cgroup", "memory", "rw,memory", root="/docker/abc")
    linux.write("memory", memory__limit_in_bytes=2 * GB, memory__usage_in_bytes=GB)
    for group in ("/docker/abc", "/docker/abc/below", "/elsewhere"):
        linux.join(f"4:memory:{group}")
        assert cgroups.free_memory_bytes(linux.proc) == GB


def test_the_machine_gives_no_more_than_the_groups_allow(monkeypatch):
    monkeypatch.setattr(cgroups, "most_cpus", lambda: 1)
    monkeypatch.setattr(cgroups, "free_memory_bytes", lambda: 1000)
    assert (machine.usable_threads(), machine.free_memory_bytes()) == (1, 1000)
    monkeypatch.setattr(cgroups, "most_cpus", lambda: None)
    monkeypatch.setattr(cgroups, "free_memory_bytes", lambda: None)
    assert machine.usable_threads() >= 1
    assert machine.free_memory_bytes() > 1000
