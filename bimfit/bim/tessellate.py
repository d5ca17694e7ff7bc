"""The child process that opens an IFC and tessellates it: ``python -m bimfit.bim.tessellate``.

It reads a request (JSON) from standard input and writes messages to standard output. A message is a line
of JSON, followed by ``bytes`` bytes of arrays. If the geometry kernel crashes or hangs, this process ends and
the one that started it goes on (:mod:`bimfit.bim.loading`).
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any, BinaryIO

import numpy as np

from bimfit.bim.ifc_index import chosen_products, describe, unknown_types
from bimfit.bim.winding import welded, wound_outwards

_FAR = 1e8


def main() -> None:
    """Answer one request."""
    out = _claim_stdout()
    request = json.loads(sys.stdin.buffer.read())
    _limit_resources(request["memory"])
    try:
        _serve(request, out)
    except Exception as error:
        _send(
            out, {"kind": "error", "message": f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]}
        )
    # skips the parser's destructors, which are slow and may crash
    os._exit(0)


def _serve(request: dict[str, Any], out: BinaryIO) -> None:
    import ifcopenshell

    model = ifcopenshell.open(request["path"])
    products = chosen_products(model, request["include"])
    if request["index"]:
        index = describe(model, products)
        index["notes"] += unknown_types(request["path"], model)
        _send(out, {"kind": "index", **index})
    left = {i: e for i, e in products.items() if i not in set(request["done"])}
    _send(out, {"kind": "begin", "count": len(left)})
    if request["one_by_one"]:
        _one_by_one(left, out)
    else:
        _all_at_once(model, left, request["threads"], out)
    _send(out, {"kind": "end"})


def _settings() -> Any:
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    settings.set("reorient-shells", True)
    return settings


def _all_at_once(model: Any, products: dict[int, Any], threads: int, out: BinaryIO) -> None:
    import ifcopenshell.geom

    if not products:
        return
    chosen = list(products.values())
    iterator = ifcopenshell.geom.iterator(
        _settings(), model, threads, include=chosen, geometry_library="opencascade"
    )
    if not iterator.initialize():
        return
    while True:
        shape = iterator.get()
        _send_shape(shape, shape.id, out)
        if not iterator.next():
            break


def _one_by_one(products: dict[int, Any], out: BinaryIO) -> None:
    import ifcopenshell.geom

    settings = _settings()
    for number, product in products.items():
        _send(out, {"kind": "start", "id": number})
        try:
            shape = ifcopenshell.geom.create_shape(settings, product, geometry_library="opencascade")
            _send_shape(shape, number, out)
        except Exception as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            _send(out, {"kind": "failed", "id": number, "reason": reason})


def _send_shape(shape: Any, number: int, out: BinaryIO) -> None:
    import ifcopenshell.util.shape as shapes

    # Local coordinates and a float64 placement: nothing is lost at map coordinates.
    local = np.asarray(shapes.get_vertices(shape.geometry), np.float64).reshape(-1, 3)
    faces = np.asarray(shapes.get_faces(shape.geometry), np.int64).reshape(-1, 3)
    placement = np.asarray(shapes.get_shape_matrix(shape), np.float64)
    with np.errstate(all="ignore"):
        world = local @ placement[:3, :3].T + placement[:3, 3]
    if not len(faces):
        _send(out, {"kind": "failed", "id": number, "reason": "has a body without faces"})
    elif not np.all(np.isfinite(world)) or np.abs(world).max() > _FAR:
        _send(
            out,
            {"kind": "failed", "id": number, "reason": "has coordinates that are not finite or absurdly far"},
        )
    else:
        kept, corners = welded(local, faces)
        if not len(corners):
            _send(out, {"kind": "failed", "id": number, "reason": "has a body without faces"})
            return
        vertices = np.ascontiguousarray(world[kept])
        corners = np.ascontiguousarray(wound_outwards(vertices - vertices.mean(axis=0), corners), np.int32)
        head = {"kind": "mesh", "id": number, "vertices": len(vertices), "faces": len(corners)}
        _send(out, head, vertices.tobytes() + corners.tobytes())


def _claim_stdout() -> BinaryIO:
    """Keep standard output for messages; what the parser prints goes nowhere."""
    mine = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    return os.fdopen(mine, "wb", buffering=1 << 16)


def _limit_resources(memory: int) -> None:
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    except (ImportError, ValueError, OSError):
        return


def _send(out: BinaryIO, head: dict[str, Any], payload: bytes = b"") -> None:
    out.write(json.dumps({**head, "bytes": len(payload)}).encode() + b"\n")
    if payload:
        out.write(payload)
    out.flush()


if __name__ == "__main__":
    main()
