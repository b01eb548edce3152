"""How many cores a process may use."""

import os

import pytest

from motionstereo_cli.runs import cores as machine


@pytest.fixture
def quota(tmp_path, monkeypatch):
    """Return a function that makes a container's quota."""

    def limit(*texts):
        paths = [tmp_path / str(number) for number in range(len(texts))]
        for path, text in zip(paths, texts, strict=True):
            path.write_text(text)
        monkeypatch.setattr(machine, "_QUOTAS", (tuple(map(str, paths)),))

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    return limit


@pytest.mark.parametrize(
    ("texts", "cores"),
    [
        (["200000 100000\n"], 2),
        (["150000 100000\n"], 2),
        (["max 100000\n"], 8),
        (["10000 100000\n"], 1),
        (["9900000 100000\n"], 8),
        (["300000\n", "100000\n"], 3),
        (["-1\n", "100000\n"], 8),
        (["nonsense"], 8),
    ],
)
def test_a_quota_counts_in_whole_cores_up_to_those_of_the_affinity(quota, texts, cores):
    quota(*texts)
    assert machine.usable_cores() == cores


def test_without_affinity_all_cores_count(quota, monkeypatch):
    quota("max 100000")
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert machine.usable_cores() == 5


@pytest.mark.parametrize(
    ("width", "height", "jobs"),
    [(640, 480, 8), (1920, 1080, 4), (3840, 2160, 1), (60_000, 60_000, 1)],
)
def test_large_frames_are_fewer_at_a_time(quota, width, height, jobs):
    quota("max 100000")
    assert machine.frames_at_once(width, height) == jobs
