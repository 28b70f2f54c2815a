"""Runs of simulated obstacles, made as the command makes them."""

from sonar_imm.cli import main


def tracked(folder, scenario='tethers', seed=1, **settings):
    """Simulate and track into `folder`; gives the folder of the run."""
    changed = [part for name, value in settings.items() for part in ('--set', f'{name}={value}')]
    bag = folder / 'scene'
    assert (
        main(
            [
                'simulate',
                'obstacle',
                str(bag),
                '--scenario',
                scenario,
                '--seed',
                str(seed),
                *changed,
            ]
        )
        == 0
    )
    assert main(['track', str(bag), str(folder / 'run')]) == 0
    return folder / 'run'
