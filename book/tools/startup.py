"""Import this module first: nbformat then starts in a fifth of the time.

nbformat imports jsonschema, which compiles a grammar of international addresses for one and a half
seconds, if the package with the grammar is installed. Notebooks do not need it.
"""

import sys

sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
