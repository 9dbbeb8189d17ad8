"""Asks a gateway with KServe's client, in a Python of its own: it wants older packages than we do.

usage: kserve_client.py http|grpc HOST:PORT MODEL FILE.npz    prints what the client made of it
"""

import asyncio
import json
import sys
from importlib import import_module

import numpy as np

KINDS = {"float32": "FP32", "float64": "FP64", "uint16": "UINT16"}


async def main(transport: str, address: str, model: str, file: str) -> None:
    kserve = import_module("kserve")
    inputs = []
    for name, array in np.load(file).items():
        inputs.append(kserve.InferInput(name, list(array.shape), KINDS[array.dtype.name]))
        inputs[-1].set_data_from_numpy(array, binary_data=False)
    request = kserve.InferRequest(model, inputs, parameters={"top_k": 4, "up": "[0, 0, 1]"})
    if transport == "grpc":
        client = kserve.InferenceGRPCClient(address)
        health = [await client.is_server_live(), await client.is_server_ready()]
        health.append(await client.is_model_ready(model))
        result = await client.infer(request)
    else:
        client = kserve.InferenceRESTClient(kserve.inference_client.RESTConfig(protocol="v2"))
        base = f"http://{address}"
        health = [await client.is_server_live(base), await client.is_server_ready(base)]
        health.append(await client.is_model_ready(base, model))
        result = await client.infer(base, request, model_name=model)
    told = {"health": health}
    for output in result.outputs:
        told[output.name] = output.as_numpy().tolist()
    await client.close()
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
