"""The table of commands, from name to "module:function". The module is imported when the command runs or --help lists it."""

import click

from wrt.core.registry import Registry

COMMANDS: Registry[click.Command] = Registry("command", {
    "animate": "wrt.cli.animate:animate",
    "bench": "wrt.cli.measure:bench",
    "build": "wrt.cli.build:build",
    "compare": "wrt.cli.compare:compare",
    "compile": "wrt.cli.compile:compile_kernels",
    "devices": "wrt.cli.devices:devices",
    "info": "wrt.cli.scene_files:info",
    "inspect": "wrt.cli.inspect:inspect",
    "profile": "wrt.cli.measure:profile",
    "render": "wrt.cli.render:render",
    "schema": "wrt.cli.scene_files:schema",
    "stability": "wrt.cli.measure:stability",
    "validate": "wrt.cli.scene_files:validate",
    "view": "wrt.cli.view:view",
    "walk": "wrt.cli.walk:walk",
    "whatif": "wrt.cli.measure:whatif",
}, "wrt.commands")
