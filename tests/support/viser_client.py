"""A browser's part of viser's protocol, for tests of a page without a browser."""

from __future__ import annotations

import json
import threading
from collections import Counter
from contextlib import contextmanager, suppress

from tests.support.waiting import WAIT_S, wait_until

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "position": (0, 0, 5), "fov": 1.0, "near": 0.1, "far": 100.0,
    "image_height": 300, "image_width": 400, "look_at": (5, 0, 5), "up_direction": (0, 0, 1),
}  # fmt: skip


class ViserClient:
    """A connection to a page, and what the page has shown there.

    Attributes
    ----------
    uuids : of controls, by label
    values : properties of controls, by uuid
    nodes : properties of nodes of the scene, by name
    counts : number of messages about a node, by its name, or about a control, by its uuid
    notes : texts of notes
    """

    def __init__(self, url: str, **headers: str):
        import viser
        from websockets.sync.client import connect

        self.uuids, self.values, self.nodes, self.notes, self.counts = {}, {}, {}, [], Counter()
        self._state = {"pointer": None, "clicks": 0, "clicked": None, "keys": [], "frame_s": 0, "count": 0}
        self._socket = connect(
            url.replace("http", "ws", 1),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            additional_headers=headers,
        )
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()
        self.send(**CAMERA)

    def send(self, **message) -> None:
        """Send a message of viser's page."""
        from msgspec import msgpack

        self.send_raw(msgpack.encode(message))

    def send_raw(self, data: str | bytes) -> None:
        """Send anything."""
        self._socket.send(data)

    def change(self, label: str, value) -> None:
        """Give a control a value, as a user does."""
        self.send(type="GuiUpdateMessage", uuid=self.uuid(label), updates={"value": value})

    def press(self, label: str) -> None:
        """Press a button."""
        self.change(label, True)

    def tell(self, **state) -> None:
        """Report a state as page.js does."""
        self._state |= state
        self._state["count"] += 1
        self.change("page state", json.dumps(self._state))

    def drag(self, name: str, wxyz, position) -> None:
        """Drag a gizmo."""
        self.send(type="TransformControlsDragStartMessage", name=name)
        self.send(type="TransformControlsUpdateMessage", name=name, wxyz=wxyz, position=position)
        self.send(type="TransformControlsDragEndMessage", name=name)

    def uuid(self, label: str) -> str:
        """Return the id of the control with a label, once it is there."""
        wait_until(lambda: label in self.uuids)
        return self.uuids[label]

    def shown(self, label: str):
        """Return the value that a control shows."""
        return self.values[self.uuid(label)]["value"]

    def wait_closed(self) -> None:
        """Wait until the page has ended the connection."""
        self._thread.join(WAIT_S)

    def close(self) -> None:
        """End the connection."""
        self._socket.close()
        self._thread.join()

    def _receive(self) -> None:
        import zstandard
        from msgspec import msgpack
        from websockets.exceptions import ConnectionClosedError

        with suppress(ConnectionClosedError):  # by a page that cannot read what was sent
            for data in self._socket:
                size = int.from_bytes(data[8:16], "little")
                inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
                for message in msgpack.decode(inner)["messages"]:
                    self._take(message)

    def _take(self, message: dict) -> None:
        kind = message["type"]
        self.counts[message.get("name", message.get("uuid"))] += 1
        if kind == "GuiUpdateMessage":
            self.values.setdefault(message["uuid"], {}).update(message["updates"])
        elif kind.startswith("Gui") and "props" in message:
            self.values[message["uuid"]] = {"value": message.get("value"), **message["props"]}
            self.uuids[message["props"].get("label")] = message["uuid"]
        elif kind == "NotificationShowMessage":
            self.notes.append(message["props"]["body"])
        elif "props" in message and "name" in message:
            self.nodes[message["name"]] = dict(message["props"])
        elif "name" in message:
            self.nodes.setdefault(message["name"], {}).update(message.get("updates", message))


@contextmanager
def connected(url: str, **headers: str):
    """Yield a ViserClient."""
    client = ViserClient(url, **headers)
    try:
        yield client
    finally:
        client.close()
