package android.content;

import android.net.ConnectivityManager;

/** As far as org.psao.android uses it. */
public class Context {
    public final ConnectivityManager connectivity = new ConnectivityManager();

    public <T> T getSystemService(Class<T> type) {
        return type.cast(connectivity);
    }
}
