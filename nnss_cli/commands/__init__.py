"""The subcommands: parse, call, print."""
