"""A URDF file as a tree of links and joints."""

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_errors import UserError, restate
from palpate_inputs import read_text
from palpate_models.numerics.frames import Array, rigid


class UrdfTree:
    """A URDF file. Raises UserError if it is not one."""

    def __init__(self, path: Path) -> None:
        with restate((OSError, ElementTree.ParseError), UserError, f"{path}: not a URDF"):
            text = read_text(path)
            if "<!ENTITY" in text:
                raise UserError(f"{path}: has XML entities, which may name other files: write their text")
            root = ElementTree.fromstring(text)
        if any("xacro" in element.tag for element in root.iter()):
            raise UserError(f"{path}: not a URDF: has xacro elements; expand it with the tool xacro")
        if root.tag != "robot":
            raise UserError(f"{path}: not a URDF: its root element is {root.tag}, expected robot")
        self.links = {link.get("name", ""): link for link in root.findall("link")}
        self.joints = root.findall("joint")
        self.joint_of = {link_name(joint, "child"): joint for joint in self.joints}
        """Joint by the link that it carries."""
        self.part = path.name
        """Link or joint that is being read, for messages."""
        named = {"link": root.findall("link"), "joint": self.joints}
        twice = (
            f"{kind} {name!r}: {count} of this name; each needs its own"
            for kind, elements in named.items()
            for name, count in Counter(element.get("name", "") for element in elements).items()
            if count > 1 or not name
        )
        self.faults = [*twice, *self._loose()]
        """Faults of the tree. With any, the rest of the file is not read."""

    def _loose(self) -> list[str]:
        """Return faults of joints whose links are not there, and of links with two joints or in none of the trees."""
        found = []
        for joint in self.joints:
            for end in ("parent", "child"):
                link = link_name(joint, end)
                if link not in self.links:
                    found.append(f"joint {joint.get('name')}: no link {link!r} in the file, its {end}")
            if self.joint_of[link_name(joint, "child")] is not joint:
                both = f"{joint.get('name')} and {self.joint_of[link_name(joint, 'child')].get('name')}"
                found.append(f"link {link_name(joint, 'child')}: has two joints above it, {both}")
        roots = [link for link in self.links if link not in self.joint_of]
        if len(roots) > 1 and not found:
            found.append(f"links {', '.join(roots)}: {len(roots)} roots, expected one")
        return found

    def chain(self, flange: str) -> list[str]:
        """Return the links from the root to the flange. Raises ValueError for a circle."""
        chain = [flange]
        while joint := self.joint_of.get(chain[-1]):
            parent = link_name(joint, "parent")
            if parent in chain:
                raise ValueError(f"link {parent}: its joints form a circle")
            chain.append(parent)
        chain = chain[::-1]
        return chain[1:] if chain[0] == "world" and len(chain) > 2 else chain

    def numbers(self, element: ElementTree.Element | None, attribute: str, default: str = "0 0 0") -> Array:
        """Return as many numbers as the default has. Raises ValueError that names the part which is being read."""
        text = default if element is None else element.get(attribute, default)
        try:
            found = np.array([float(part) for part in text.split()])
        except ValueError:
            found = np.zeros(0)
        if len(found) != len(default.split()):
            raise ValueError(f"{self.part}: {attribute} is {text!r}, expected {len(default.split())} number(s)")
        if not np.isfinite(found).all():
            raise ValueError(f"{self.part}: {attribute} is not finite: {text}")
        return found

    def pose(self, element: ElementTree.Element | None) -> Array:
        """Return the pose of an `origin`, shape (4, 4)."""
        return rigid(Rotation.from_euler("xyz", self.numbers(element, "rpy")).as_matrix(), self.numbers(element, "xyz"))


def link_name(joint: ElementTree.Element, end: str) -> str:
    """Return the name of a joint's `parent` or `child` link."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")
