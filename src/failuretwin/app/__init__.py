"""The command line and its pictures.

Any function here may raise `InputError` or `OutputError`; `cli.main` shows their text.
"""
