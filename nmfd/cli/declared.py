"""Options that set what a declaration of settings (nmfd.runs.config) declares.

Type, unit, range, default and text are read there, but only for the option's own help or when it gets a value: the
declarations bring pydantic, and the help that lists the commands is quicker than that.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from importlib import import_module
from typing import Any

import click


class Declared(click.Option):
    """An option --SOME-KEY of the setting some_key.

    declaration: "module:Class" of nmfd.runs.config.Settings
    instead: what a command does without the option, where that is not the declared default, which is {} in it
    """

    def __init__(self, names: Sequence[str], *, declaration: str, instead: str | None = None, **options: Any):
        super().__init__(names, type=None if options.get("is_flag") else click.UNPROCESSED, **options)
        self._declaration, self._instead = declaration, instead

    @cached_property
    def _kind(self) -> Any:
        module, _, name = self._declaration.partition(":")
        return getattr(import_module(module), name)

    @cached_property
    def _schema(self) -> dict[str, Any]:
        from nmfd.runs import schema  # pydantic

        root = schema.of(self._kind)
        return schema.resolved(root, root["properties"][self.name])

    @property
    def _default(self) -> Any:
        return self._kind.model_fields[self.name].get_default()

    @property
    def _is_list(self) -> bool:
        return self._schema.get("type") == "array"

    @property
    def _allowed(self) -> str:
        from nmfd.runs import schema  # pydantic

        return schema.allowed(self._schema) + (", separated by commas" if self._is_list else "")

    def get_default(self, ctx: click.Context, call: bool = True) -> Any:
        """The declared one, unless there is another `instead`, or it is a flag."""
        return super().get_default(ctx, call) if self._instead is not None or self.is_flag else self._default

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        """What the words of the command line say. A usage error for what is not allowed."""
        if not isinstance(value, str):
            return super().type_cast_value(ctx, value)
        from nmfd.runs import config  # pydantic

        try:
            words = [part.strip() for part in value.removesuffix(",").split(",")] if self._is_list else value
            return config.parsed(self._kind, str(self.name), words)
        except ValueError:
            raise click.BadParameter(config.got(self._allowed, value), ctx=ctx, param=self) from None

    def make_metavar(self, ctx: click.Context) -> str:
        """The choices, if there are any."""
        return "N,..." if self._is_list else f"[{'|'.join(self._schema['enum'])}]" if "enum" in self._schema else "N"

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """As click has it, with the text of the declaration."""
        text, unit = self._schema["description"], self._schema.get("unit", "-")
        self.help = self.help or f"{text[0].upper()}{text[1:]}{'' if unit == '-' else f' [{unit}]'}."
        return super().get_help_record(ctx)

    def get_help_extra(self, ctx: click.Context) -> Any:
        """Default and range."""
        if self.is_flag:
            return {}
        default = shown(self._default)
        extra = {"default": default if self._instead is None else self._instead.format(default)}
        return extra if "enum" in self._schema or "text" in self._allowed else {**extra, "range": self._allowed}


def shown(value: Any) -> str:
    """A default as the command line takes it."""
    if isinstance(value, tuple):
        return ",".join(map(shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def declared(declaration: str, *keys: str, **options: Any) -> Callable[[Callable], Callable]:
    """A decorator: an option for every one of these keys of a declaration. The rest as of `Declared`."""

    def decorate(command: Callable) -> Callable:
        for key in reversed(keys):
            command = click.option(f"--{key.replace('_', '-')}", cls=Declared, declaration=declaration, **options)(
                command
            )
        return command

    return decorate
