"""What every long run needs, and nothing but that.

``campaign`` spreads work over ``processes`` of this machine or a Ray ``cluster``, ``rows`` keep results and go on
where they stopped, ``progress`` says how far it is, ``compiling`` that kernels are compiled first. ``signals`` are
Ctrl-C and SIGTERM, ``running`` is how files are written, ``typed`` how lists are read, ``config_files`` reads what
a run left, ``errors`` are the one-line kind, ``options`` what commands share, ``provenance`` a digest of the code
behind a result.
"""
