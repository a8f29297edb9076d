"""Where the classes of abcd_ns.nerfstudio once were; says what opens a config.yml that names them here."""

# PyYAML, by which ns-eval, ns-viewer, ns-render and ns-export load a config.yml, hands this on.
raise ImportError(
    "the run was trained before abcd_ns.plugin became abcd_ns.nerfstudio; open it with the version that "
    'trained it: abcd/settings.json beside its config.yml names that under "versions"'
)
