"""`python -m lodestone.cli`, the same as `lodestone`."""

from lodestone.cli.program import main

raise SystemExit(main())
