package org.psao.android;

import android.app.Activity;
import android.app.Application;
import android.os.Bundle;
import org.psao.PsaoPlayer;

/**
 * Pauses a player while its activity is not in front, and closes it when the activity goes. The
 * client stays, and so does its last frame.
 *
 * <p>Threads: the main one.
 */
public final class PsaoLifecycle implements Application.ActivityLifecycleCallbacks {
    private final Activity activity;
    private final PsaoPlayer player;

    private PsaoLifecycle(Activity activity, PsaoPlayer player) {
        this.activity = activity;
        this.player = player;
    }

    /**
     * Follows an activity until it is destroyed: call it in {@code onCreate}.
     *
     * @param activity which
     * @param player pauses with it
     */
    public static void follow(Activity activity, PsaoPlayer player) {
        activity.getApplication().registerActivityLifecycleCallbacks(
                new PsaoLifecycle(activity, player));
    }

    @Override
    public void onActivityPaused(Activity which) {
        if (which == activity) {
            player.pause();
        }
    }

    @Override
    public void onActivityResumed(Activity which) {
        if (which == activity) {
            player.resume();
        }
    }

    @Override
    public void onActivityDestroyed(Activity which) {
        if (which == activity) {
            player.close();
            activity.getApplication().unregisterActivityLifecycleCallbacks(this);
        }
    }

    @Override
    public void onActivityCreated(Activity which, Bundle state) {}

    @Override
    public void onActivityStarted(Activity which) {}

    @Override
    public void onActivityStopped(Activity which) {}

    @Override
    public void onActivitySaveInstanceState(Activity which, Bundle state) {}
}
