"""`vad config`: every setting there is, for people and for editors."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from vad.commands.console import print_json
from vad.config import AgentSettings, Settings
from vad.config.documents import agent_reference, hub_reference
from vad.config.reference import settings_schema

config_app = typer.Typer(no_args_is_help=True, help="Every setting: meaning, unit, limits, default.")

AgentOption = Annotated[bool, typer.Option("--agent", help="Of agent.yaml instead of vad.yaml.")]


@config_app.command()
def reference(agent: AgentOption = False) -> None:
    """A settings file with every setting, its meaning, unit, limits and default as comments.

    Example:  vad config reference | less
    """
    text = agent_reference() if agent else hub_reference()
    sys.stdout.buffer.write(text.encode())  # the same bytes in every locale: this goes into a file


@config_app.command()
def schema(agent: AgentOption = False) -> None:
    """The JSON schema of the settings, for editors that help while one types.

    Example:  vad config schema > vad.schema.json, and as the first line of vad.yaml:
    # yaml-language-server: $schema=vad.schema.json
    """
    print_json(settings_schema(AgentSettings if agent else Settings))
