"""xacro, the macro language of ROS: files are expanded by ROS's own library, which here may neither run code nor
read outside the resource paths.

A xacro file holds Python expressions, which the library evaluates by `eval`; it refuses names that begin with two
underscores, which does not stop an attacker. Here an expression is checked first: it may compute, compare, index
and call, but neither define functions nor reach the insides of objects. Expansion is not bounded in time or memory.
"""

from __future__ import annotations

import ast
import os
import re
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import NamedTuple
from xml.parsers.expat import ExpatError

from sonar_gl.core.errors import Error, nearest_of_many
from sonar_gl.core.warn import warn_caller
from sonar_gl.scene.sdf.resources import GIVE_FOLDERS, SKIP_MISSING, Resources

# What the library must have, so that nothing here is replaced in vain.
REPLACED = "abs_filename_spec", "eval_extension", "load_yaml", "parse", "safe_eval"
# Parts of expressions: neither functions nor generators, whose insides lead out.
NODES = (
    *(ast.Expression, ast.BoolOp, ast.BinOp, ast.UnaryOp, ast.IfExp, ast.Compare, ast.Call, ast.keyword),
    *(ast.Constant, ast.Attribute, ast.Name, ast.Subscript, ast.Slice, ast.List, ast.Tuple, ast.Dict),
    *(ast.Set, ast.ListComp, ast.SetComp, ast.DictComp, ast.comprehension, ast.Starred, ast.Load, ast.Store),
    *(ast.operator, ast.unaryop, ast.boolop, ast.cmpop),
)
REFUSED_ATTRIBUTES = re.compile("_.*|format|format_map")  # `format` reads attributes that its text names
REFUSED_BUILTINS = "type", "vars"  # of those that xacro offers as `python.type`
ELEMENTS = "node", "elt", "tag"  # names of the library's variables that hold the element it expands
MAX_NESTING = 50  # of files that include files
PART = re.compile("is not defined|unknown macro name")  # of messages about a file that is a part of another
ARGUMENT = re.compile(r"(\w+):=(\S*)")  # as ROS's own commands take arguments


def split_arguments(what: str) -> tuple[str, dict[str, str]]:
    """Return the path of a scene, and the arguments after it: name -> value.

    >>> split_arguments("my robot.xacro namespace:=rov debug:=0")
    ('my robot.xacro', {'namespace': 'rov', 'debug': '0'})
    """
    words, arguments = re.split(r"(\s+)", what), {}
    while len(words) > 2 and (found := ARGUMENT.fullmatch(words[-1])):
        arguments = {found[1]: found[2], **arguments}
        del words[-2:]
    return "".join(words), arguments


def expand(path: Path, arguments: dict[str, str], resources: Resources) -> bytes:
    """Return the XML that a xacro file expands to.

    Raises Error if the file is no valid xacro, lacks an argument, an expression is refused, or a file is missing.
    """
    try:
        return _Expansion(path, arguments, resources).xml()
    except Exception as why:  # expressions raise anything
        cause, location = why, _location_of(why, path)
        while getattr(cause, "exc", None) is not None and not isinstance(cause, Error):
            cause = cause.exc
        if isinstance(cause, RecursionError):
            cause = Error("macros and includes must end (these call themselves)")
        if isinstance(cause, Error):
            raise Error(f"{location}: {cause}") from None
        text = " ".join(str(why).split())
        hint = "; if other files include this one, give one of them" if PART.search(text) else ""
        raise Error(f"{location}: xacro cannot expand this ({text}{hint})") from None


def _location_of(why: Exception, path: Path) -> str:
    """Return file, line and element of what was expanded when an exception was raised; else the file alone.

    The library passes no elements on with its exceptions, but its functions hold them.
    """
    found, trace = None, why.__traceback__
    while trace is not None:
        variables = trace.tb_frame.f_locals
        elements = [variables[name] for name in ELEMENTS if hasattr(variables.get(name), "getUserData")]
        found = next(filter(None, (one.getUserData(_Line.__name__) for one in elements)), found)
        trace = trace.tb_next
    if found is None:
        return f"{path}"
    file, line, tag = found
    return f"{path}: {'' if file == str(path) else f'{file}: '}line {line}, <{tag}>"


class _Line(NamedTuple):
    """Where an element stands: file, line, and the tag that it had there. Copies of the element have it, too."""

    file: str
    line: int
    tag: str

    def handle(self, _operation, key, _data, _source, copy) -> None:
        """Give a copy of the element this line, as the DOM's handler of it."""
        copy.setUserData(key, self, self)


def _parse_with_lines(xml: bytes, file: str):
    """Return the document of an XML file whose elements have their _Line; document types and entities are refused.

    Raises ExpatError if the XML is broken, DefusedXmlException if it declares a document type or entities.
    """
    from defusedxml.expatbuilder import DefusedExpatBuilderNS

    builder = DefusedExpatBuilderNS(forbid_dtd=True)
    start = builder.start_element_handler

    def start_with_line(name, attributes):
        start(name, attributes)
        line = _Line(file, builder.getParser().CurrentLineNumber, builder.curNode.tagName)
        builder.curNode.setUserData(_Line.__name__, line, line)

    builder.start_element_handler = start_with_line
    return builder.parseString(xml)


class _Arguments(dict):
    """The arguments of an expansion, which note the names that files ask for, by `<xacro:arg>` and `$(arg)`."""

    def __init__(self, given: dict[str, str]):
        super().__init__(given)
        self.asked = set()

    def __contains__(self, name) -> bool:
        self.asked.add(name)
        return super().__contains__(name)


class _Expansion:
    """The expansion of one file, by a copy of the library's module of its own: the module holds state."""

    def __init__(self, path: Path, arguments: dict[str, str], resources: Resources):
        spec = find_spec("xacro")
        self.xacro = module_from_spec(spec)
        spec.loader.exec_module(self.xacro)
        missing = [name for name in REPLACED if not hasattr(self.xacro, name)]
        if missing:
            raise Error(f"the library xacro must be of version 2.1 (this one has no {missing[0]!r})")
        self.path, self.resources = path, resources
        self._eval, self._load_yaml = self.xacro.safe_eval, self.xacro.load_yaml
        self._absolute = self.xacro.abs_filename_spec
        self.xacro.safe_eval = self._evaluate
        self.xacro.eval_extension = self._substitute
        self.xacro.load_yaml = self._read_yaml
        self.xacro.abs_filename_spec = self._absolute_path
        self.xacro.parse = self._parse
        for name in ("message", "warning", "error", "print_location"):
            setattr(self.xacro, name, _silent(name))
        self.arguments = _Arguments(arguments)
        self._given = set(arguments)

    def xml(self) -> bytes:
        """Return the expanded XML."""
        library = self.xacro
        library.init_stacks(str(self.path))
        library.substitution_args_context["arg"] = self.arguments
        document = self._parse(None, str(self.path))
        self.symbols = library.create_global_symbols()
        for name in REFUSED_BUILTINS:
            del self.symbols["python"][name]
        library.eval_all(document.documentElement, library.Table(), library.Table(self.symbols))
        known = self.arguments.asked
        for name in sorted(self._given - known):
            warn_caller(f"{self.path}: the file has no argument {name!r} ({nearest_of_many(name, known)})")
        return document.toxml("utf-8")

    def _parse(self, _, name: str):
        """Return the document of a file; `optional` includes go on if it is missing."""
        from defusedxml import DefusedXmlException
        from defusedxml.minidom import parseString
        from lxml.etree import tostring

        if not Path(name).is_file():
            self.xacro.filestack.pop()
            raise self.xacro.XacroException(exc=_MissingFileError(f"there is no file {name!r} (included)"))
        if len(self.xacro.filestack) > MAX_NESTING:
            raise RecursionError
        path = self._allowed(name)
        xml = self.resources.read(path)
        try:
            return _parse_with_lines(xml, name)
        except (ExpatError, DefusedXmlException):
            # raises the error of any broken file; else the file is one that Gazebo reads all the same
            return parseString(tostring(self.resources.parse_xml(xml, path)))

    def _absolute_path(self, name: str) -> str:
        """Return the path of an included file; a package that is not found is an error here."""
        if package := re.search("package://([^/]+)", name):
            raise Error(
                f"the ROS package {package[1]!r} must be in the resource paths; give the folder that holds it "
                f"({GIVE_FOLDERS}; searched: {', '.join(map(str, self.resources.roots))}; its "
                f"macros cannot be skipped ({SKIP_MISSING} are for models and meshes))"
            )
        return self._absolute(name)

    def _allowed(self, name: str) -> Path:
        """Return the path of a file that is in the resource paths; raise an Error if it is not."""
        found = self.resources.find(str(Path(name).absolute()), Path("/"), f"{self.path}")
        if found is None:
            raise Error(f"there is no file {name!r}")
        return found

    def _read_yaml(self, name: str):
        return self._load_yaml(str(self._allowed(self._absolute_path(str(name)))))

    def _evaluate(self, expression: str, names, more=None):
        """Return the value of an expression, after it is checked."""
        for node in ast.walk(ast.parse(expression.strip(), mode="eval")):
            refused = None
            if not isinstance(node, NODES):
                refused = type(node).__name__
            elif isinstance(node, ast.Attribute) and REFUSED_ATTRIBUTES.fullmatch(node.attr):
                refused = node.attr
            elif isinstance(node, ast.Name) and node.id.startswith("__"):
                refused = node.id
            if refused is not None:
                raise Error(f"expressions must be simple ones (got {expression!r}; refused is {refused})")
        return self._eval(expression, names, more)

    def _substitute(self, text: str):
        """Return the value of `$(command arguments)`."""
        command, _, rest = text[2:-1].strip().partition(" ")
        rest = rest.strip()
        if command == "find":
            found = self.resources.find_package(rest)
            return f"package://{rest}" if found is None else str(found)
        if command == "arg":
            if rest not in self.arguments:
                raise Error(
                    f'the argument {rest!r} has no default; give it after the file, as in "{self.path} '
                    f'{rest}:=VALUE"'
                )
            return self.arguments[rest]
        if command in ("env", "optenv"):
            name, _, default = rest.partition(" ")
            if command == "env" and name not in os.environ:
                raise Error(f"the environment variable {name!r} is not set")
            return os.environ.get(name, default)
        if command == "dirname":
            return str(Path(self.xacro.filestack[-1]).absolute().parent)
        if command == "cwd":
            return os.getcwd()
        if command == "eval":
            return str(self._evaluate(rest, {**self.symbols, **self.symbols["python"], **self.arguments}))
        raise Error(
            f"unknown substitution (got {text!r}; known are arg, cwd, dirname, env, eval, find, optenv)"
        )


def _silent(name: str):
    """Return a function of this name that writes nothing; files call it by its name."""

    def write(*_, **__):
        return ""

    write.__name__ = name
    return write


class _MissingFileError(Error, OSError):
    """An included file that does not exist; the library looks for an OSError."""
