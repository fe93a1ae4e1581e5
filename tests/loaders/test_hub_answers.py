"""What a Hub, or what stands in its place, may answer: anything but what it should ends in a
message, soon."""

import socket
import threading
from contextlib import closing

import pytest
from huggingface_hub import HfApi

from fpp_ml_bench.errors import FppBenchError, RemoteError
from fpp_ml_bench.loaders import hub as hub_module
from fpp_ml_bench.loaders.hub import Hub, Unreachable


def served(content, drip=False):
    """A server on this machine that answers every request with these bytes, or begins to and never
    ends."""
    server, kept = socket.create_server(("127.0.0.1", 0)), []

    def loop():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            connection.recv(65536)
            connection.sendall(content)
            kept.append(connection) if drip else connection.close()

    threading.Thread(target=loop, daemon=True).start()
    return server


def hub_at(server, monkeypatch, **options):
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    hub = Hub(**options)
    hub.endpoint = f"http://127.0.0.1:{server.getsockname()[1]}"
    hub._api = HfApi(endpoint=hub.endpoint, token="x")
    return hub


def json_answer(text):
    head = (
        f"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: "
        f"{len(text)}\r\nConnection: close"
    )
    return f"{head}\r\n\r\n{text}".encode()


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "null",
        "5",
        '"text"',
        "",
        "<html>",
        "{}",
        '{"sha": 5}',
        '{"id": "a/b", "siblings": 3}',
        "[[[[",
    ],
)
@pytest.mark.parametrize("question", ["state", "check_token"])
def test_an_answer_of_another_shape_is_a_message(text, question, monkeypatch):
    with closing(served(json_answer(text))) as server:
        hub = hub_at(server, monkeypatch, sending=question == "check_token")
        try:
            hub.state("dataset", "some/data") if question == "state" else hub.check_token()
        except FppBenchError as error:
            assert (
                "reading dataset some/data" if question == "state" else "asking who the token"
            ) in str(error)
        else:
            assert (
                text.startswith("{") and question == "check_token"
            )  # a token of nobody, who may publish nothing


def test_one_that_never_answers_is_given_up(monkeypatch):
    monkeypatch.setattr(hub_module, "ANSWER_S", 0.2)
    for content in (b"", b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\n["):
        with closing(served(content, drip=True)) as server:
            hub = hub_at(server, monkeypatch, sending=False)
            with pytest.raises(
                Unreachable,
                match=r"gave no answer within 0\.2 s; check the network and HF_ENDPOINT",
            ):
                hub.state("dataset", "some/data")


def test_redirects_without_end_are_a_message(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    head = (
        f"HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:{port}/again\r\nContent-Length: "
        f"0\r\nConnection: close"
    )
    real = socket.create_server
    monkeypatch.setattr(socket, "create_server", lambda address: real(("127.0.0.1", port)))
    with closing(served(f"{head}\r\n\r\n".encode())) as server, pytest.raises(RemoteError):
        hub_at(server, monkeypatch, sending=False).state("dataset", "some/data")
