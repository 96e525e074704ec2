"""Imported first, it makes nbformat start in a fifth of the time.

nbformat imports jsonschema, and that compiles a grammar of addresses in any alphabet, for one and
a half seconds, wherever the package with the grammar is installed. No notebook needs it.
"""

import sys

sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
