"""Run `python -m docs.studies.homes`: print what `home_counts` and `plan_counts` count in plans and homes of seeds."""

from collections import Counter

import numpy as np

from converters.generate import GenerationError, design_building
from converters.generate.homes.config import TIERS, home_config
from converters.generate.homes.plans import home_plan
from converters.generate.models.cad import HOME_TRAIN_MODELS, LIBRARY, tints
from docs.studies import command_line
from docs.studies.homes import WRONG, home_counts, plan_counts


def main() -> None:
    """Print the counts of plans, then those of homes."""
    parser = command_line(__doc__)
    parser.add_argument("--plans", type=int, default=150)
    parser.add_argument("--homes", type=int, default=43)
    parser.add_argument("--seed", type=int, default=650_000, help="of the first plan and home")
    parser.add_argument("--tier", choices=TIERS, default="furnished")
    args = parser.parse_args()
    cfg, counts, names = home_config(args.tier, {}), Counter[str](), list[Counter[str]]()
    categories = Counter[str]()
    for seed in range(args.seed, args.seed + args.plans):
        counts += plan_counts(*home_plan(cfg, np.random.default_rng(seed)))
    for seed in range(args.seed, args.seed + args.homes):
        try:
            home = design_building(seed, cfg)
        except GenerationError as error:
            print(error)
            counts["homes refused"] += 1
            continue
        items = (*home.items, *home.plan.built_in)
        counts += home_counts(home.plan, home.uses, items)
        names.append(Counter(i.model.name for i in items))
        categories.update(i.model.category for i in items)
    for name in dict.fromkeys((*WRONG, *sorted(counts))):
        print(f"{name:40} {counts[name]:5}")
    if names:
        every = sum(names, Counter[str]())
        print(f"{'pieces':40} {every.total():5}, of {len(every)} models, {np.mean([len(n) for n in names]):.1f} a home")
    for category, count in categories.most_common(20):
        models = sum(len(tints(n)) for n in HOME_TRAIN_MODELS if LIBRARY[n].category == category)
        print(f"{category:20} {count / len(names):5.1f} a home, of {models} models")


if __name__ == "__main__":
    main()
