"""Every link, every name of a file or module, and every command in every README and notebook is
right."""

import importlib
import re
from functools import cache
from pathlib import Path

import click
import pytest
from commands import MAINS
from documents import FILES, ROOT, kind, read

from cosim.plant.strategy import parse
from nmfd.runs import shipped

# What a reader replaces, and files and folders that are not kept here: a path that begins so need
# not exist.
PLACEHOLDERS = (
    "runs",
    "networks/mycity",
    "scenarios/mycity",
    "mycity",
    "city.",
    "mine",
    "scenarios/mine",
    "networks/mine",
    "counts.csv",
    "detectors.csv",
    "regions.csv",
    "about.csv",
    "edges.xml",
    "dpc-pcrg.onnx",
    "bologna/",
    "ingolstadt21/",
    "cologne8/",
    "cities/dublin/",
    "luxembourg/",
    "networks/ingolstadt",
    "networks/cologne",
    "networks/dublin",
    "FILE",
    "NAME",
    "build/",
    "SCENARIO",
    "DIR",
)
SUFFIXES = (
    "py|md|toml|csv|png|txt|json|nc|npz|pt|onnx|xml|gz|parquet|css|js|j2|ipynb|html|mp4|log|"
    "tmp|lock"
)
PATH = re.compile(rf"(?:\.?[\w+=-]+/)*\.?[\w.+-]*\w\.(?:{SUFFIXES})|(?:\.?[\w+-]+/)+[\w+-]*")
PYTHON = re.compile(r"(?:nmfd|cosim)(?:\.\w+)+")
OPTION = re.compile(r"--[a-z][\w-]*")


@pytest.fixture(params=FILES, ids=lambda file: str(file.relative_to(ROOT)), scope="module")
def document(request):
    return read(request.param)


def test_every_link_leads_somewhere(document):
    for link in document.links:
        target, _, anchor = link.partition("#")
        if re.match(r"https?://|mailto:", target):
            continue
        file = document.file.parent / target if target else document.file
        assert file.exists(), f"{link}: no such file"
        if anchor:
            assert anchor in read(file / "README.md" if file.is_dir() else file).headings, (
                f"{link}: no such heading"
            )


def test_every_name_of_a_file_is_one(document):
    paths = [
        name
        for name in document.names
        if PATH.fullmatch(name) and not name.startswith(PLACEHOLDERS)
    ]
    wrong = [name for name in paths if not (_is_there(name, document) or _is_written(name))]
    assert not wrong, "no such files, and no code that writes them"


def test_every_name_of_a_module_is_one(document):
    for name in document.names:
        if PYTHON.fullmatch(name) and name.rpartition(".")[2] not in SUFFIXES.split("|"):
            assert _resolves(name), name


def test_every_option_is_one_of_a_command(document, pytestconfig):
    for name in document.names:
        words = name.split()
        if words[0] in MAINS and len(words) > 1:
            _check_words(words, complete=False)
        elif OPTION.fullmatch(words[0]):
            assert words[0] in _options() or _is_of_pytest(words[0], pytestconfig), name


def test_every_block_of_code_is_shell_toml_or_python(document):
    for block in document.blocks:
        assert kind(block), block


def test_every_command_is_valid(document, pytestconfig):
    for words in document.commands:
        program = words[0]
        if program in MAINS:
            _check_words(words, complete="..." not in words)
        elif program in ("python", "python3"):
            assert words[1] in ("-m", "-c") or (ROOT / words[1]).is_file(), words
        elif program == "pytest":
            known, unknown = pytestconfig._parser.parse_known_and_unknown_args(
                [w for w in words[1:] if w != "..."]
            )
            assert not unknown, words
            assert all((ROOT / file).exists() for file in known.file_or_dir), words
        elif program == "pip":
            extras = re.findall(r"\[([\w,]+)\]", words[-1])
            project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
            for extra in ",".join(extras).split(","):
                assert not extra or re.search(rf"^{extra} = \[", project, re.MULTILINE), words
        elif program == "dask":
            module = pytest.importorskip(f"distributed.cli.dask_{words[1]}", reason="no extra dask")
            known = {
                opt for param in module.main.params for opt in (*param.opts, *param.secondary_opts)
            }
            assert {word for word in words if OPTION.match(word)} <= known, (
                words
            )  # the certificates are the reader's


def _check_words(words: list[str], *, complete: bool) -> None:
    """A command of nmfd or cosim; one that is not complete may lack arguments."""
    group = MAINS[words[0]]
    if words[1].startswith("--") and not complete:
        assert words[1] in {
            opt for param in group.get_params(click.Context(group)) for opt in param.opts
        }, words
        return
    assert words[1] in group.commands, f"{words[0]} has no command {words[1]}"
    command = group.commands[words[1]]
    if not complete:
        own = {opt for param in command.params for opt in (*param.opts, *param.secondary_opts)}
        assert {word.partition("=")[0] for word in words if OPTION.match(word)} <= {
            *own,
            "--help",
        }, words
        return
    context = command.make_context(
        words[1], words[2:]
    )  # a usage error for what the command does not take
    for name, value in context.params.items():
        if name in ("controller", "controllers", "against", "reference") and value:
            for controller in value if isinstance(value, tuple) else value.split(","):
                own = controller.partition(".py:")[0]
                if set(controller) & set("*?[") or (
                    own != controller and own.startswith(PLACEHOLDERS)
                ):
                    continue  # a pattern, or the reader's own
                parse(controller)
        for path in value if isinstance(value, tuple) else [value]:
            if isinstance(path, Path) and name not in (
                "out",
                "target",
                "scenario" if words[1] == "import" else "",
            ):
                _check_path(path, words)
        if name == "policies":
            for policy in value:
                _check_path(Path(policy.partition("=")[2]), words)


def _check_path(path: Path, words: list[str]) -> None:
    if not path.as_posix().startswith(PLACEHOLDERS):
        found = shipped.found(path, shipped.SCENARIO, shipped.NETWORK, beside=None)
        assert found.is_absolute() or (ROOT / found).exists(), f"{path}: no such file; {words}"


@cache
def _tree() -> tuple[set[str], str]:
    """The names of all files, and all that stands in the code of the packages."""
    names, code = set(), []
    for folder in ("cosim", "networks", "nmfd", "scenarios", "tests", ".ci"):
        for file in (ROOT / folder).rglob("*"):
            names.add(file.name)
            if file.suffix in (".py", ".j2") and folder in ("cosim", "nmfd"):
                code.append(file.read_text(encoding="utf-8"))
    return names, "\n".join(code)


def _is_there(name: str, document) -> bool:
    folder = document.file.parent
    if "/" in name.rstrip("/"):
        places = (
            folder,
            ROOT,
            ROOT / folder.relative_to(ROOT).parts[0] if folder != ROOT else ROOT,
        )
        return any((place / name).exists() for place in places)
    if name.endswith(".py"):  # of the package that the page is about
        return any(folder.rglob(name)) or any(
            (place / name).is_file() for place in (*folder.parents, ROOT)
        )
    return (folder / name).exists() or (ROOT / name).exists() or name in _tree()[0]


def _is_written(name: str) -> bool:
    """Whether code of the packages names it: files that commands write, or SUMO's programs."""
    return Path(name).name in _tree()[1]


def _resolves(name: str) -> bool:
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(thing, part) and part not in getattr(thing, "__annotations__", {}):
                return False
            thing = getattr(thing, part, None)
        return True
    return False


def _is_of_pytest(option: str, pytestconfig: pytest.Config) -> bool:
    try:
        return option not in pytestconfig._parser.parse_known_and_unknown_args([option, "1"])[1]
    except pytest.UsageError:  # it takes something else than 1
        return True


@cache
def _options() -> set[str]:
    return {"--help", "--version"} | {
        opt
        for group in MAINS.values()
        for command in group.commands.values()
        for param in command.params
        for opt in (*param.opts, *param.secondary_opts)
    }
