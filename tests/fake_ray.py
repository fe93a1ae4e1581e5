"""A stand-in for Ray with the part of its interface that the package uses: tasks run in this
process, when their result is asked for, on what pickling leaves of their arguments. ``dies`` names
the task whose node dies for good."""

import pickle
import socket
import sys
from types import SimpleNamespace

import pytest


class RayError(Exception):
    pass


class RayTaskError(RayError):
    def __init__(self, cause):
        super().__init__(str(cause))
        self.cause = cause


class FakeRay(SimpleNamespace):
    def __init__(self):
        super().__init__(addresses=[], open=False, started=0, dies=None)
        self.exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def init(self, address, **options):
        self.addresses.append(address)
        self.open = True

    def shutdown(self):
        self.open = False

    def put(self, value):
        return SimpleNamespace(value=pickle.dumps(value))

    def remote(self, max_retries):
        assert max_retries > 0
        return lambda function: SimpleNamespace(remote=lambda *arguments: (function, arguments))

    def get(self, task):
        assert self.open
        function, arguments = task
        self.started += 1
        if self.started == self.dies:
            raise RayError("The worker died unexpectedly")
        values = [pickle.loads(a.value) if isinstance(a, SimpleNamespace) else a for a in arguments]
        try:
            return function(*pickle.loads(pickle.dumps(values)))
        except Exception as error:
            raise RayTaskError(error) from error


@pytest.fixture
def fake_ray(monkeypatch):
    """Ray's stand-in; ``address`` is one where somebody answers."""
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    with socket.create_server(("127.0.0.1", 0)) as server:
        fake.address = f"ray://127.0.0.1:{server.getsockname()[1]}"
        yield fake
