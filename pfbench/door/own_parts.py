"""Own parts: classes and objects of the user as files of a folder that a search path names."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

import pfbench
from pfbench.core.parameter_checks import require
from pfbench.door.own_source import find_home, name_file, write_module
from pfbench.door.parts import READ_OTHERWISE, Part, describe_value, place_words, plain_errors
from pfbench.files.atomic_write import write_atomically
from pfbench.job.config import compose, list_groups
from pfbench.job.trust import FOLDERS, WRITTEN, split_trust

# arguments of the call of each stage of a particle filter; a scheme is part of the resampler
STAGES = {
    "proposal": ("model", "belief", "record", "draws"),
    "moves": ("model", "belief", "resampled", "draws"),
    "weight_update": ("model", "log_w", "x", "log_ratio", "record"),
    "resampler": ("model", "belief", "log_a", "n", "draws"),
    "auxiliary_weights": ("model", "belief", "record"),
    "initial_proposal": ("model", "record", "n", "draws"),
    "particle_count": ("belief",),
    "scheme": ("a", "n", "draws"),
}
_MODEL = "model.StateSpaceModel", "a model, which is a module of torch", ("log_likelihood",)
# by a method that only such a part has: base class, role, and what it inherits
_BASES = {
    "propagate": _MODEL,
    "observation": _MODEL,
    "draw_errors": (
        "noise.NoiseRegime",
        "a noise regime",
        ("process_factors", "error_distribution"),
    ),
}


@plain_errors()
def make_own(
    thing: Any, name: str | None = None, /, *, base: str = "sir", **arguments: Any
) -> Part:
    """Make a part of a class or an object of your own.

    A class of a script or a notebook is stored with all that it uses and named by its source: another source is another job.

    Args:
        thing: Filter, stage of a particle filter, model, scenario or noise regime. An object, or its class. Also the class
            of a network that `pfbench.train` trains as a proposal.
        name: Name in tables and figures. The name of the class by default. A part with a name of pfbench is `Own NAME`,
            and `own_name` where a study chooses it.
        base: Particle filter that receives a stage.
        **arguments: Arguments of a class. For a scenario also `divergence_threshold`, the error above which a run has
            lost the track.

    Returns:
        The part.

    Raises:
        ValueError: If the class has not the methods of any part, or is defined inside of a function.
        TypeError: If an argument cannot be written into a file.
    """
    if isinstance(thing, Part):
        raise TypeError(
            f"own must receive a class or an object, got the part {thing}. Pass it to run unchanged."
        )
    group, stage = find_group(thing)
    cls = thing if isinstance(thing, type) else type(thing)
    # exec in a namespace without a name gives classes of the module builtins
    has_source = cls.__module__ != "builtins"
    require(
        has_source,
        cls.__name__,
        "be in a file or a notebook",
        "a class without a source",
        "Save it in a module.",
    )
    title = name or _name_thing(thing, arguments)
    if name_file(title) in (*list_groups()[group], *READ_OTHERWISE):
        title = f"Own {title}"
    limit = arguments.pop("divergence_threshold", None) if group == "scenario" else None
    writer = _NodeWriter()
    if stage == "network":
        node = writer.write_network(thing, arguments)
    elif isinstance(thing, type):
        node = writer.write_class(thing, arguments)
    else:
        node = writer.write(thing, title)
    if not isinstance(thing, type) and arguments:
        raise TypeError(
            f"{title} must be a class if arguments are given, got an object. Use own({type(thing).__name__}, "
            f"{next(iter(arguments))}=...)."
        )
    if stage:
        node = writer.put_stage(base, stage, node)
    node |= _describe_paper(group, title, node, limit)
    return writer.store(group, title, node)


def _name_thing(thing: Any, arguments: Mapping[str, Any]) -> str:
    """Name an object or a class by its class, a plain simulation of a model by its model."""
    cls = thing if isinstance(thing, type) else type(thing)
    model = arguments.get("model", getattr(thing, "model", None))
    if cls is not pfbench.scenario.ModelSimulation or model is None:
        return cls.__name__
    return model.name if isinstance(model, Part) else _name_thing(model, {})


def find_group(thing: Any) -> tuple[str, str]:
    """Find the group of an object or a class by its methods, and its stage of a particle filter, if it is one."""
    cls = thing if isinstance(thing, type) else type(thing)
    if issubclass(cls, pfbench.model.StateSpaceModel):
        missing = sorted(getattr(cls, "__abstractmethods__", ()))
        require(
            not missing,
            cls.__name__,
            f"define {', '.join(missing)} to be a model",
            "a class without them",
            "Add them.",
        )
        return "model", ""
    for method, (base, role, inherited) in _BASES.items():
        require(
            not callable(getattr(cls, method, None)) or all(hasattr(cls, n) for n in inherited),
            cls.__name__,
            f"be a subclass of pfbench.{base} to be {role}",
            f"a subclass of {cls.__mro__[:2][-1].__name__}",
            f"Write class {cls.__name__}({base.partition('.')[2]}).",
        )
    if _is_network(cls):
        return "filter", "network"
    methods = {"noise": ("draw_errors",), "scenario": ("draw",), "filter": ("init", "step")}
    for group, names in methods.items():
        if all(callable(getattr(cls, name, None)) for name in names):
            return group, ""
    call = _find_call(cls)
    names = tuple(inspect.signature(call).parameters)[1:] if call else ()
    stage = next((kind for kind, arguments in STAGES.items() if arguments == names), "")
    if stage:
        return "filter", stage
    forms = "; ".join(f"{kind} __call__(self, {', '.join(a)})" for kind, a in STAGES.items())
    raise ValueError(
        f"{describe_value(thing)} must have the methods of a part: filter init and step, scenario draw, noise regime draw_errors, "
        f"or of a stage: {forms}. Got {_list_methods(cls)}. Add the method."
    )


def _is_network(cls: type) -> bool:
    """Return whether a class is a module of torch that is made of a number of features and a dimension of the noise."""
    from torch import nn

    names = list(inspect.signature(cls).parameters) if issubclass(cls, nn.Module) else []
    return names[:2] == ["features", "noise"]


def _find_call(cls: type) -> Callable[..., Any] | None:
    """Return the method `__call__` that a class or a parent defines in Python."""
    calls = (vars(parent).get("__call__") for parent in cls.__mro__)
    return next((call for call in calls if inspect.isfunction(call)), None)


def _list_methods(cls: type) -> str:
    """List the public methods of a class for a message."""
    names = [n for n in vars(cls) if callable(vars(cls)[n]) and not n.startswith("_")]
    call = _find_call(cls)
    names += [f"__call__{inspect.signature(call)}"] if call else []
    return ", ".join(names) or "none"


def _describe_paper(
    group: str, title: str, node: Mapping[str, Any], limit: float | None
) -> dict[str, Any]:
    """Return the node `paper` of a part: its name in reports."""
    if group == "model":
        return {}
    paper: dict[str, Any] = {"name": title}
    if group == "filter":
        family = "particle" if "particles" in node else "kalman"
        paper |= {"long_name": title, "family": family, "proposed": True}
    else:
        paper["words"] = title
    return {"paper": paper | ({} if limit is None else {"divergence_threshold": limit})}


class _NodeWriter:
    """Writer of objects as nodes of a configuration.

    Attributes:
        folders: Folders that the node needs.
        packages: Packages that it needs.
        words: Words that choose the model of a scenario.
    """

    def __init__(self) -> None:
        self.folders: list[str] = []
        self.packages: list[str] = []
        self.model: Part | None = None

    def write(self, value: Any, path: str) -> Any:
        """Describe a value: an object of dataclasses, a model, a part, numbers, texts and lists of them."""
        if isinstance(value, Part):  # by its composed node
            node = compose([*value.words(), *place_words([value])]).values[value.group]
            self.packages += value.packages
            return {key: entry for key, entry in node.items() if key != "paper"}
        if isinstance(value, pfbench.model.StateSpaceModel):  # by the arguments of its constructor
            positional, options = value._arguments
            bound = inspect.signature(type(value)).bind(*positional, **options)
            return self.write_class(type(value), bound.arguments)
        if isinstance(value, type):
            return self.write_class(value, {})
        if dataclasses.is_dataclass(value):
            fields = [f for f in dataclasses.fields(value) if f.init]
            changed = {f.name: getattr(value, f.name) for f in fields if not _is_default(f, value)}
            return self._write_fields(type(value), changed)
        if isinstance(value, list | tuple):
            return [self.write(item, f"{path}[{k}]") for k, item in enumerate(value)]
        if isinstance(value, Mapping):
            return {str(key): self.write(item, f"{path}.{key}") for key, item in value.items()}
        if hasattr(value, "item") and getattr(value, "shape", None) == ():
            value = value.item()
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if _is_without_state(value):
            return self._write_fields(type(value), {})  # a class without arguments
        raise TypeError(
            f"{path} must be numbers, texts, lists or objects of dataclasses, got {describe_value(value)}. "
            + (
                "Pass numbers or a list, such as array.tolist(), and make the object in the class."
                if "." in path
                else "Pass the class with its arguments: pfbench.own(Class, argument=...)."
            )
        )

    def write_class(self, cls: type, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Describe a class with its arguments. A number of particles that is not given is that of the study."""
        parameters = inspect.signature(cls).parameters
        takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        if unknown := [key for key in arguments if key not in parameters and not takes_any]:
            raise ValueError(
                f"{cls.__name__} must have the argument {unknown[0]}, got a class with {', '.join(parameters) or 'none'}. "
                "Correct the name."
            )
        required = [
            key for key, p in parameters.items()
            if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL) and key not in arguments
        ]  # fmt: skip
        node = self._write_fields(cls, arguments)
        if "particles" in required:
            node["particles"] = "${particles}"
            required.remove("particles")
        require(
            not required,
            cls.__name__,
            f"receive {', '.join(required)}",
            "no value",
            f"Use own({cls.__name__}, {'=..., '.join(required)}=...).",
        )
        return node

    def write_network(self, cls: Any, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Describe the class of a network. The proposal gives it the number of features and the dimension of the noise."""
        if not isinstance(cls, type):
            raise TypeError(
                f"{type(cls).__name__} must be a class, got an object. Pass the class: the proposal makes the network."
            )
        return {**self._write_fields(cls, arguments), "_partial_": True}

    def _write_fields(self, cls: type, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Describe a class with the values of its arguments."""
        values = {
            key: self._write_model_of_scenario(value)
            if key == "model"
            else self.write(value, f"{cls.__name__}.{key}")
            for key, value in fields.items()
        }
        return {"_target_": self.name_class(cls), **values}

    def _write_model_of_scenario(self, value: Any) -> Any:
        """Choose the model of a scenario as that of the job, so that its filters have the same one."""
        self.model = value if isinstance(value, Part) else make_own(value)
        self.folders += self.model.folders
        self.packages += self.model.packages
        return "${model}"

    def name_class(self, cls: type) -> str:
        """Name a class so that another process can import it."""
        if cls.__module__.startswith("pfbench."):
            home = find_home(cls)
            require(
                home in [f"pfbench.{folder}" for folder in FOLDERS],
                cls.__name__,
                "be a public class of pfbench",
                f"one of {cls.__module__}",
                "Choose a name of pfbench.filter, pfbench.model, pfbench.noise or pfbench.scenario.",
            )
            return f"{home}.{cls.__name__}"
        module = (
            write_module(cls)
            if cls.__module__ == "__main__" or "<locals>" in cls.__qualname__
            else cls.__module__
        )
        package = module.partition(".")[0]
        split_trust([f"trust=[{package}]"])
        self.packages.append(package)
        return f"{module}.{cls.__qualname__}"

    def put_stage(self, base: str, stage: str, node: dict[str, Any]) -> dict[str, Any]:
        """Return a shipped particle filter with another stage."""
        base = "neural_sir" if stage == "network" and base == "sir" else base
        config = compose([f"filter={base}"])
        values = {key: value for key, value in config.values["filter"].items() if key != "paper"}
        require("particles" in values, "base", "be a particle filter", base, "Use base='sir'.")
        if config.uses_shared_particles:
            values["particles"] = "${particles}"
        if stage == "network":
            proposal = {**values["proposal"], "network": node, "checkpoint": "${checkpoint}"}
            return {**values, "proposal": proposal}
        if stage == "scheme":
            return {**values, "resampler": {**values["resampler"], "scheme": node}}
        return {**values, stage: [node] if stage == "moves" else node}

    def store(self, group: str, title: str, node: dict[str, Any]) -> Part:
        """Write the file of a part into a folder named by its content."""
        name = name_file(title)
        head: dict[str, Any] = {}
        if self.model is not None:
            head = {"defaults": ["_self_", {"override /model@_global_.model": self.model.name}]}
        text = yaml.safe_dump({**head, **node}, sort_keys=False, allow_unicode=True)
        digest = hashlib.sha256(f"{group}/{name}\n{text}".encode()).hexdigest()[:10]
        folder = Path(WRITTEN) / f"{name}_{digest}"
        path = folder / group / f"{name}.yaml"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(
                path, lambda file: file.write(f"# {title}, of a class in Python.\n{text}".encode())
            )
        changes = self.model.changes if self.model is not None else ()
        folders = dict.fromkeys([str(folder), *self.folders])
        return Part(
            group, name, tuple(changes), tuple(folders), tuple(dict.fromkeys(self.packages))
        )


def _is_without_state(value: object) -> bool:
    """Return whether an object is only its class: a constructor without arguments, and no attributes."""
    cls = type(value)
    is_general = cls.__module__.partition(".")[0] in ("builtins", "numpy", "torch", "functools")
    return not is_general and cls.__init__ is object.__init__ and not getattr(value, "__dict__", {})


def _is_default(field: Any, holder: Any) -> bool:
    """Return whether a field of an object has its default value."""
    is_made = field.default_factory is not dataclasses.MISSING
    default = field.default_factory() if is_made else field.default
    is_equal = default == getattr(holder, field.name)
    return bool(is_equal.all() if hasattr(is_equal, "all") else is_equal)  # of an array
