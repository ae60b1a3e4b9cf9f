"""The command `infogoal`, a file for each group of its subcommands. Nothing else in the package imports it.

A command is a function: its parameters are the flags, its docstring is the help, and what it returns is the exit status
(tyro). What takes long to import is imported where a command needs it, so that help comes at once.
"""
