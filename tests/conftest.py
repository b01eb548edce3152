"""Shared by all tests."""

import pytest


def pytest_addoption(parser):
    parser.addoption(
        "--renew", action="store_true", help="accept what the code gives now as expected"
    )


@pytest.fixture(scope="session")
def renew(request):
    return request.config.getoption("--renew")
