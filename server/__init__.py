"""The HTTP service: uploads, jobs, results and the status page. Never imports torch.

`create_app(settings)` in `server.app` builds it. The database is the truth about jobs, RQ on Redis
only carries them to the workers, and `server.reconcile` keeps the two in step.
"""
