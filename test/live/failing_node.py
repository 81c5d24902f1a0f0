"""A live node that fails while it runs, and needs three seconds to stop its device."""

from __future__ import annotations

import time

from greenroof_ros.live.node import LiveNode, live_command


class FailingNode(LiveNode):
    def on_timer(self, now: float) -> None:
        print(1 / 0)

    def on_stop(self) -> None:
        time.sleep(3.0)


main = live_command(lambda: FailingNode("recorder", "recorder"), "failing", __doc__, lambda _: [])

if __name__ == "__main__":
    main()
