"""Shared by all tests."""

import signal

import pytest
from hypothesis import settings

from motionstereo_cli.runs.cores import prepare, usable_cores

# Before the libraries load: their idle threads would take the time of other tests.
prepare()

# The same examples at every run, however slow the machine: what passes here passes elsewhere.
# `make fuzz` draws new ones.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("new", deadline=None)
settings.load_profile("same")


def pytest_configure():
    # Where who started the tests ignores interrupts, all they start would ignore them too.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    parser.addoption(
        "--renew", action="store_true", help="accept what the code gives now as expected"
    )
    parser.addoption(
        "--trials", type=int, default=2, help="simulated recordings that check is tried on"
    )
    parser.addoption(
        "--fuzz-seconds", type=float, default=0, help="try each reader for so long, at least once"
    )
    parser.addoption("--fuzz-seed", type=int, default=0, help="the first seed of each reader")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    return usable_cores() + 1  # some tests wait for processes that they began


#: Files whose tests take longest: begun first, they do not run alone at the end.
SLOW = ("test_torture", "test_resume", "test_stored", "test_docs", "test_batch", "test_check")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.stem not in SLOW)


def pytest_generate_tests(metafunc):
    if "trial" in metafunc.fixturenames:
        metafunc.parametrize("trial", range(metafunc.config.getoption("--trials")))


@pytest.fixture(scope="session")
def renew(request):
    return request.config.getoption("--renew")
