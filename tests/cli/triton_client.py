"""Asks a gateway with Triton's client, in a process without our own messages of the protocol.

usage: triton_client.py http|grpc HOST:PORT MODEL FILE.npz    prints what the client made of it
"""

import importlib
import json
import sys

import numpy as np

KINDS = {"float32": "FP32", "float64": "FP64", "uint16": "UINT16"}


def main(transport: str, address: str, model: str, file: str) -> None:
    triton = importlib.import_module(f"tritonclient.{transport}")
    client = triton.InferenceServerClient(address)
    health = client.is_server_live(), client.is_server_ready(), client.is_model_ready(model)
    metadata = client.get_model_metadata(model)
    if transport == "grpc":
        metadata = {"name": metadata.name, "inputs": [{"name": t.name} for t in metadata.inputs]}
    inputs = []
    for name, array in np.load(file).items():
        inputs.append(triton.InferInput(name, array.shape, KINDS[array.dtype.name]))
        inputs[-1].set_data_from_numpy(array)
    told = {"health": health, "model": metadata["name"], "inputs": metadata["inputs"]}
    result = client.infer(model, inputs, parameters={"top_k": 4, "up": "[0, 0, 1]"})
    for name in ("T_cloud_hand", "score", "width", "object"):
        told[name] = result.as_numpy(name).tolist()
    one = [triton.InferRequestedOutput("score")]
    timed = {"timeout": 30_000_000}  # microseconds
    asked = client.infer(model, inputs, model_version="1", outputs=one, **timed)
    told["alone"] = [asked.as_numpy("score") is not None, asked.as_numpy("width") is None]
    if transport == "http":
        told["models"] = [each["name"] for each in client.get_model_repository_index()]
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
