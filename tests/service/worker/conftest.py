import json
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
from benchmarks.dummy import DummyCatalogue

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.errors import Problem
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer
from edgegrasp_service.worker.process import Answer, Job


class Asker:
    """Hands requests to a worker's `answer`, as the front does."""

    transport = "http"

    def answer(self, method: str, body: bytes, media_type: str = "", query: str = "") -> Answer:
        job = Job(method, self.transport, body, 30.0, media_type, query)
        told = answer(job, DummyCatalogue(), Settings())
        assert bool(told.body) == (told.error is None)
        if told.error is not None:
            assert told.error.status < 500, told.facts.traceback
            told.error.detail.encode()  # what cannot be encoded cannot be sent
            assert len(told.error.detail) < 2000
        return told

    def problem(self, method: str, body: bytes, media_type: str = "", query: str = "") -> Problem:
        error = self.answer(method, body, media_type, query).error
        assert error is not None
        for part in (error.field, error.value, error.fix):
            assert part
            assert part in error.detail
        return error


class RestAsker(Asker):
    def file(self, file_format: str, data: bytes, **options: Any) -> Answer:
        query = urlencode(options)
        return self.answer("DetectGrasps", data, f"application/x-{file_format}", query)

    def send(self, document: Any, score: bool = False) -> Answer:
        body = document if isinstance(document, bytes) else json.dumps(document).encode()
        return self.answer("ScoreGrasps" if score else "DetectGrasps", body, "application/json")


class GrpcAsker(Asker):
    transport = "grpc"

    def file(self, file_format: str, data: bytes, **options: Any) -> Answer:
        encoded = grasp_pb2.EncodedCloud(format=file_format, data=data)
        return self.send(grasp_pb2.DetectGraspsRequest(encoded=encoded, options=options))

    def send(self, message: Any) -> Answer:
        scores = isinstance(message, grasp_pb2.ScoreGraspsRequest)
        method = "ScoreGrasps" if scores else "DetectGrasps"
        return self.answer(method, message.SerializeToString())


@pytest.fixture(scope="session")
def rest() -> RestAsker:
    return RestAsker()


@pytest.fixture(scope="session")
def grpc_() -> GrpcAsker:
    return GrpcAsker()


@pytest.fixture(params=["rest", "grpc_"])
def both(request: pytest.FixtureRequest) -> RestAsker | GrpcAsker:
    found: RestAsker | GrpcAsker = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="session")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.1, 0.1, (60, 3)).astype(np.float32)
