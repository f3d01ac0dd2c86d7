"""`python -m splatct_client` is the `splatct` command."""

from splatct_client.cli import main

raise SystemExit(main())
