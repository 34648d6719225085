package android.app;

import android.os.Bundle;
import java.util.ArrayList;
import java.util.List;

/** As far as org.psao.android uses it; tests see who listens. */
public class Application {
    public final List<ActivityLifecycleCallbacks> listeners = new ArrayList<>();

    public void registerActivityLifecycleCallbacks(ActivityLifecycleCallbacks listener) {
        listeners.add(listener);
    }

    public void unregisterActivityLifecycleCallbacks(ActivityLifecycleCallbacks listener) {
        listeners.remove(listener);
    }

    public interface ActivityLifecycleCallbacks {
        void onActivityCreated(Activity activity, Bundle state);

        void onActivityStarted(Activity activity);

        void onActivityResumed(Activity activity);

        void onActivityPaused(Activity activity);

        void onActivityStopped(Activity activity);

        void onActivitySaveInstanceState(Activity activity, Bundle state);

        void onActivityDestroyed(Activity activity);
    }
}
