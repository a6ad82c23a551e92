"""Libraries that only some uses need: the extras of pyproject.toml."""

from importlib.util import find_spec

from nmfd.errors import InputError


def there(module: str) -> bool:
    """Whether it is installed."""
    return find_spec(module) is not None


def need(what: str, extra: str, *modules: str) -> None:
    """InputError that names the `extra` to install, where `what` needs one of `modules` that is not installed."""
    if missing := [module for module in modules if not there(module)]:
        raise InputError(
            f"{what}: needs {', '.join(missing)}; install the extra {extra} with: pip install -e '.[{extra}]'"
        )
