"""Where the repository stands, and the real images beside it (absent in a user's checkout)."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
REAL = ROOT.parent / "shared" / "real"
