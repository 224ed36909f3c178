"""Controllers: they decide the efforts of a train from what is measured and what was learnt."""

from trainlog.extras import require

require("daqp")
