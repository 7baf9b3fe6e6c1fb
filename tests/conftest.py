"""What all tests need from the process that runs them."""

import os
import signal
import tempfile
from pathlib import Path

# A shell starts commands in the background with these signals ignored, which the commands of the tests would inherit.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

os.environ["FREEOCC3D_MODELS"] = str(Path(tempfile.gettempdir()) / "freeocc3d-tests-without-models")
"""Maps that name no encoder have that of no installed model, whatever the user has installed."""
