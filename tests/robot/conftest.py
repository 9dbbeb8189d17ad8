import pytest


@pytest.fixture(scope="module", params=["fr3", "ur5"])
def robot(request):
    from edgegrasp_robot import load_robot

    return load_robot(request.param)


@pytest.fixture(scope="module")
def fr3():
    from edgegrasp_robot import load_robot

    return load_robot("fr3")
