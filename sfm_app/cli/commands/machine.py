"""Commands about the program and the machine that it runs on."""

from typing import Any

import click
from click.shell_completion import get_completion_class

from sfm_app.cli.options import settings_from_flags, settings_options
from sfm_app.cli.output import print_json, print_lines, print_text, table

SHELLS = ("bash", "zsh", "fish")


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def doctor(as_json: bool) -> None:
    """Show what this machine has and lacks."""
    from sfm_app.cli.doctor import examine

    found = examine()
    print_json(found) if as_json else print_text(table(found))


@click.command()
@settings_options
def config(**flags: Any) -> None:
    """Print all settings as TOML, including the changes by other options."""
    print_lines(settings_from_flags(flags).to_toml().splitlines())


@click.command()
def plugins() -> None:
    """List features, estimators, calibrators, file formats and depth methods."""
    from sfm_app.plugins import load_plugins

    found = load_plugins()
    for title, parts in (
        ("features", found.features),
        ("estimators", found.estimators),
        ("calibrators", found.calibrators),
        ("exporters", found.exporters),
        ("scene exporters", found.scene_exporters),
        ("depth methods", found.depth_methods),
    ):
        print_text([f"{title}:", *(f"  {line}" for line in table({p.name: p.summary for p in parts.values()}))])


@click.command()
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a script for SHELL that completes commands, flags and names of methods.

    \b
    bash: sfm-app completion bash >> ~/.bashrc
    zsh:  sfm-app completion zsh >> ~/.zshrc
    fish: sfm-app completion fish > ~/.config/fish/completions/sfm-app.fish
    """
    kind = get_completion_class(shell)
    if kind is not None:
        print_lines(kind(ctx.find_root().command, {}, "sfm-app", "_SFM_APP_COMPLETE").source().splitlines())
