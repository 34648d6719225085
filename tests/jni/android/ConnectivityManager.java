package android.net;

import java.util.ArrayList;
import java.util.List;

/** As far as org.psao.android uses it; tests see who listens. */
public class ConnectivityManager {
    public final List<NetworkCallback> listeners = new ArrayList<>();

    public void registerDefaultNetworkCallback(NetworkCallback listener) {
        listeners.add(listener);
    }

    public void unregisterNetworkCallback(NetworkCallback listener) {
        listeners.remove(listener);
    }

    public static class NetworkCallback {
        public void onAvailable(Network network) {}
    }
}
