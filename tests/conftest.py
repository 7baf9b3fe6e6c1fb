"""What all tests need from the process that runs them."""

import signal

# A shell starts commands in the background with these signals ignored, which the commands of the tests would inherit.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)
