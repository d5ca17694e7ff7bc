import sys
from pathlib import Path

# helpers beside the tests, under the import mode that has no packages
sys.path.insert(0, str(Path(__file__).parent))
