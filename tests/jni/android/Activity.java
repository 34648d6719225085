package android.app;

import android.content.Context;

/** As far as org.psao.android uses it. */
public class Activity extends Context {
    private final Application application;

    public Activity(Application application) {
        this.application = application;
    }

    public Application getApplication() {
        return application;
    }
}
