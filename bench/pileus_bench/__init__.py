"""Error against time: scenes x methods x budgets, and other renderers on the same axes."""
